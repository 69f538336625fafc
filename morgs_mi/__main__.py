"""`python -m morgs_mi` is `morgs-mi`."""

import sys

from morgs_mi.cli import main

sys.exit(main())
