"""glTF and OpenUSD files of a stream."""

from morgs_mi.platform.extras import enter


def register() -> None:
    """Enter what this extra adds to the package."""
    enter(__name__, "exports", {"gltf": "commands:Gltf", "usd": "commands:Usd"})
