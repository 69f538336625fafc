"""`python -m morgs_mi`, the same as `morgs-mi`."""

import sys

from morgs_mi.cli.main import main

sys.exit(main())
