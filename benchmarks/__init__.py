"""Benchmarks of the source checkout (``python src/study.py study=...``); what is installed leaves them out."""
