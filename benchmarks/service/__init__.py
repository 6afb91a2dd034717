"""The service over HTTP: service levels (run the package), `scaling`, `soak`."""
