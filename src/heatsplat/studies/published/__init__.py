"""The published tables: printed figures as data, where the data sets come from, and ours beside the papers'."""
