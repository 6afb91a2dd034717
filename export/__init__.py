"""Export of trained models to scene files, and conversion from and to other formats. Used from a checkout; not part of
the installed package."""
