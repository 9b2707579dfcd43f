"""Samples from tables: our own text, and the text tables and Parquet files that
other programs write."""
