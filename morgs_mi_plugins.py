"""The integrators of morgs_mi for Mitsuba's entry point `mitsuba`, which loads this module after
each set_variant().

It is light: the package is imported when the first integrator is made. LLVM must be found by
Mitsuba itself, because `morgs_mi.platform.llvm` is too late then.
"""

from functools import partial
from typing import Any

import mitsuba as mi

__all__: list[str] = []


def _integrator(plugin: str, props: Any) -> Any:
    from morgs_mi.gaussian_integrator import integrator

    return integrator(plugin, props)


for _plugin in ("gaussian_splat", "splat_path"):
    mi.register_integrator(_plugin, partial(_integrator, _plugin))
