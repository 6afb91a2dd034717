"""How exactly a model's deformation can be computed: in which number format, and how much a chain of layers multiplies
every error made on the way."""
