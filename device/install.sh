#!/bin/sh
# Installs the agent and all that its sources need, without a network: `sudo sh install.sh [/opt/iort]`.
# The environment is made with $PYTHON, /usr/bin/python3 unless told otherwise, and sees its packages, such as rospy.
# Another run, from another version's folder too, updates it.
set -eu
die() { echo "install.sh: $1" >&2; exit 1; }
environment=$(realpath -m "${1:-/opt/iort}")
python=${PYTHON:-/usr/bin/python3}
cd "$(dirname "$0")"
[ "$(uname -m)" = ARCHITECTURE ] || die "these packages are for ARCHITECTURE, and this is $(uname -m)"
"$python" -c 'import sys; sys.exit(not (3, 8) <= sys.version_info < (3, 14))' ||
  die "Python must be 3.8 to 3.13, got $("$python" --version 2>&1): name another, PYTHON=/path/to/python3"
# Without pip, so that Debian's python3-venv is not needed.
[ -x "$environment/bin/python" ] || "$python" -m venv --without-pip --system-site-packages "$environment"
"$environment/bin/python" "$(ls pip-*.whl)/pip" --disable-pip-version-check --isolated install --quiet \
  --no-index --find-links . --only-binary :all: --require-hashes --requirement requirements.txt
"$environment/bin/iort-agent" --version
