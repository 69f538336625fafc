"""What `morgs_mi.extras` adds to the registries of the package: the only place outside of it that
names the studio.

A registry is a table in the module that uses it, such as the commands of `morgs_mi.cli`. An entry
is imported when it is used. An extension from outside this package does not need this table: it
registers itself where it is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pkgutil import resolve_name
from typing import Any

STUDIO: Mapping[str, Mapping[str, str]] = {
    "commands": {
        "calibrate": "commands.captures:Calibrate",
        "demo": "commands.demo:Demo",
        "import": "commands.import_frames:Import",
        "info": "commands.captures:Info",
        "live": "commands.live:Live",
        "sweep": "commands.sweep:Sweep",
        "synth": "commands.synth:Synth",
    },
    "exports": {"gltf": "commands.exports:Gltf", "usd": "commands.exports:Usd"},
    "integrators": {"splat_path": "light.splat_path:SplatPathIntegrator"},
    "renderings": {"insert": "light.insert"},
    "layouts": {
        "dynamic3dgs": "layouts.dynamic3dgs:READER",
        "qualisys": "layouts.qualisys:READER",
        "anipose": "layouts.anipose:READER",
    },
    "image checks": {"poses": "calibration.checks.rig_check:pose_problems"},
    "camera refinement": {"first frame": "calibration.refine:refine_cameras"},
    "flow sources": {
        "onnx": "networks.flow_network:onnx",
        "onnx-unit": "networks.flow_network:onnx_unit",
        "onnx-signed": "networks.flow_network:onnx_signed",
    },
    "mask refiners": {"sam2": "networks.sam2:sam2"},
    "image distances": {"lpips": "networks.lpips:Lpips"},
}
"""Entries by registry and name, as MODULE or MODULE:NAME inside `morgs_mi.extras`."""


def place_of(registry: str, name: str) -> str:
    """Return the full place of an entry, MODULE or MODULE:NAME."""
    return f"morgs_mi.extras.{STUDIO[registry][name]}"


def studio_entry(registry: str, name: str) -> Any:
    """Return the class, function or module that the studio adds to a registry under a name."""
    return resolve_name(place_of(registry, name))


def studio_function(registry: str, name: str) -> Callable[..., Any]:
    """Return the function of an entry, which is imported when it is called."""
    return lambda *arguments: studio_entry(registry, name)(*arguments)
