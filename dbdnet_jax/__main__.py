"""``python -m dbdnet_jax`` is ``dbdnet-register``."""

import sys

from dbdnet_jax.cli import main

if __name__ == "__main__":  # not where a spawned process imports it
    sys.exit(main())
