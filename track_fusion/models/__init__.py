"""Motion and measurement models."""
