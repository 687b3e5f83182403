"""Columns of numbers out of files: CSV, spreadsheets and what libraries read."""
