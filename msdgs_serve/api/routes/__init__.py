"""The routes of the service. Long work runs in threads, not on the event loop."""
