"""Filters, one a file: pure predict and update over leading batch axes."""
