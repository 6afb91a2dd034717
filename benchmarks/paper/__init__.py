"""The paper's tables: its published numbers, and the same systems trained here beside them."""
