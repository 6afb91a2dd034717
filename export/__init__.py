"""Offline jobs between training and serving. Used from a checkout; no part of the installed package."""
