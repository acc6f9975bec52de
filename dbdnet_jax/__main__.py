"""``python -m dbdnet_jax`` is ``dbdnet-register``."""

import sys

from dbdnet_jax.cli import main

sys.exit(main())
