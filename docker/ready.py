"""Exit status 0 if the service in this container is ready for requests."""

import http.client
import os
import sys

connection = http.client.HTTPConnection("127.0.0.1", int(os.environ.get("MSDGS_PORT", "8000")), timeout=2)
try:
    connection.request("GET", "/ready")
    sys.exit(0 if connection.getresponse().status == 200 else 1)
except OSError as error:
    sys.exit(f"not ready: {error}")
