"""Number formats for a model's deformation, and the report on its stability in them."""
