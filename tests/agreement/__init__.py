"""Agreement with published programs: outputs of their own code, stored as vectors with their commit and command."""
