#!/bin/sh
# Find a Python 3.11 and run the set-up with it. PYTHON=/path/to/python3.11 chooses one.
set -eu
here=$(dirname "$0")
for python in ${PYTHON:-python3.11 python3 python}; do
    if "$python" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null; then
        exec "$python" "$here/set_up.py" "$@"
    fi
done
cat >&2 <<'MESSAGE'
make setup: no Python 3.11 here (the newest version that both pybullet and the ROS 2 wheels exist for).
  Debian 12, Ubuntu 22.04:  apt install python3.11 python3.11-dev python3.11-venv
  elsewhere, without root:  pyenv install 3.11    or    uv python install 3.11
then make setup again, or point at it: make setup PYTHON=/path/to/python3.11
MESSAGE
exit 1
