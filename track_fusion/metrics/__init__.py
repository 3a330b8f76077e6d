"""Measures of accuracy and consistency."""
