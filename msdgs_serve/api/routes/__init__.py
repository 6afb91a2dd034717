"""The calls of the service. What takes long is done off the event loop."""
