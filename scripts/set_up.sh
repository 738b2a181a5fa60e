#!/bin/sh
# Find a Python that RoboXim runs on, and run the set-up with it. PYTHON=/path/to/python3.12 chooses one.
set -eu
here=$(dirname "$0")
for python in ${PYTHON:-python3.11 python3.12 python3.13 python3 python}; do
    if "$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
        exec "$python" "$here/set_up.py" "$@"
    fi
done
cat >&2 <<'MESSAGE'
make setup: no Python 3.11, 3.12 or 3.13 here (the versions that the wheels of PyBullet and ROS 2 exist for).
  Debian 12:                apt install python3.11 python3.11-dev python3.11-venv
  Ubuntu 24.04:             apt install python3.12 python3.12-dev python3.12-venv
  elsewhere, without root:  pyenv install 3.12    or    uv python install 3.12
then make setup again, or point at it: make setup PYTHON=/path/to/python3.12
MESSAGE
exit 1
