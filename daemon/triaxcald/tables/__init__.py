"""Samples from tables: the native CSV, and the text tables and Parquet files that
other programs write."""
