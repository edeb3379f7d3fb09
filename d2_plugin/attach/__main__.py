"""`python -m d2_plugin.attach`."""

import os
import sys

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before torch is imported; see d2_plugin.commands.cli.main

from d2_plugin.attach.launch import main

sys.exit(main(sys.argv[1:]))
