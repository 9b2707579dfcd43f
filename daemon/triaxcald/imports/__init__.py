"""Logs that others recorded, as recordings of ours."""
