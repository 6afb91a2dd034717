"""Export of trained models to scene files, and conversion from and to other formats."""
