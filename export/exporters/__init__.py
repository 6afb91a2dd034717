"""Scene files out: to formats that other viewers read. One file a format; `proof` reads back what was written."""
