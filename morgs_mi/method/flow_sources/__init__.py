"""Sources of optical flow.

Every module of this package is imported here. A new one only has to register itself (see
`flow_registry`).
"""

from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES

FLOW_SOURCES.fill(__name__, __path__, "flow sources")
