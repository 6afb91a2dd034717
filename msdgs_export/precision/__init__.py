"""The report on the stability of a model's deformation in float32."""
