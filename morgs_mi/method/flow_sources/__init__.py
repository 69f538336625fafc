"""Sources of optical flow.

Every module of this package is imported here. A new one only has to register itself (see
`flow_registry`).
"""

from importlib import import_module
from pkgutil import iter_modules

from morgs_mi.core.extras import extra_function, places
from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
for _name in places("flow sources"):
    FLOW_SOURCES.register(*_name.split(":"))(extra_function("flow sources", _name))
