"""`python -m morgs_mi`, the same as `morgs-mi`, except that Python imports the package first."""

import sys

from morgs_mi_command import main

sys.exit(main())
