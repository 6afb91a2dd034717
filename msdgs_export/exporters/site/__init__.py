"""A scene as a folder of files that shows it in a browser, from any file server."""
