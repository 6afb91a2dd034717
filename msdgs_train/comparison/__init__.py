"""Systems compared: every one on every scene with every seed, under one budget, to one table and two plots."""
