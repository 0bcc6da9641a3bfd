"""What other Python code builds on: `pixel2catch.make` and its kind, and views for other libraries."""
