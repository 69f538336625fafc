"""Commands and exports of the command line that belong to the studio."""

import morgs_mi.cli  # noqa: F401  (it imports the modules of this package, so it must come first)
