#!/bin/sh
# pip for the build, with the certificates in the build secret `ca` if it is given.
[ ! -s /run/secrets/ca ] || export PIP_CERT=/run/secrets/ca
exec /opt/tools/bin/pip "$@"
