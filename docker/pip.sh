#!/bin/sh
# pip of the build, with the certificates of the build secret `ca` where it is given.
[ ! -s /run/secrets/ca ] || export PIP_CERT=/run/secrets/ca
exec /opt/tools/bin/pip "$@"
