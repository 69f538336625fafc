"""Options that set a `StreamConfig` or a `ReadConfig`, shared by several commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import reduce
from operator import or_
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    cast,
    dataclass_transform,
    get_type_hints,
)

from tyro.conf import FlagCreatePairsOff, arg, subcommand
from tyro.constructors import PrimitiveConstructorSpec

from morgs_mi.capture.held_out import TestViews
from morgs_mi.capture.timeline import ReadConfig
from morgs_mi.loop.stream_config import PresetName, StreamConfig, apply_preset
from morgs_mi.platform.config import apply_values, read_config
from morgs_mi.platform.documentation import field_docs, with_pages

# The setting of every option. All others are set in a file.
SETTINGS = {
    "seed": "seed",
    "num_gaussians": "fit.num_gaussians",
    "first_frame_steps": "fit.first_frame_steps",
    "first_frame_seconds": "fit.first_frame_seconds",
    "epochs": "fit.epochs",
    "sh_degree": "fit.sh_degree",
    "flow": "motion.flow_method",
    "masks": "motion.mask_method",
    "quality": "codec.quality",
    "target_size": "codec.target_size",
    "refine_cameras": "fit.refine_cameras",
    "exposure": "fit.exposure",
}

_DEFAULTS = StreamConfig()
Options = TypeVar("Options")
# Classes of options; `fill_help` reads the docstrings of their fields.
_OPTIONS: list[Any] = []
# A channel that commands render.
ChannelName = Literal["color", "motion", "confidence", "depth", "alpha"]
# A switch that is off by default.
Flag = Annotated[bool, FlagCreatePairsOff]
# Names of cameras, none by default.
Without = Annotated[tuple[str, ...], arg(metavar="CAMERA ...")]
# Names or indices of held-out cameras.
HeldOut = Annotated[tuple[str, ...], arg(metavar="CAMERA ...")]
_STOPS = (
    "Stops by which PNG files and videos are brightened; by default the stream's, 0 for a "
    "recording of 8 bits."
)


def held_out(names: Sequence[str]) -> TestViews:
    """Return held-out cameras, given by name or index, or as `none` or `auto`, as `load_capture`
    takes them.
    """
    keywords: dict[tuple[str, ...], TestViews] = {("none",): None, ("auto",): "auto"}
    return keywords.get(tuple(names), tuple(names))


@dataclass_transform(frozen_default=True)
def options(command: type[Options]) -> type[Options]:
    """Return a frozen dataclass of options, whose help is made of their docstrings."""
    _OPTIONS.append(dataclass(frozen=True)(command))
    return command


def fill_help() -> None:
    """Set the help of all options, and of the configs among them, to their docstrings, each one
    paragraph; tyro would keep the line breaks of the source.
    """
    for command in _OPTIONS:
        for kind in get_type_hints(command).values():
            if is_dataclass(kind) and kind not in _OPTIONS:
                _OPTIONS.append(kind)
        for name, text in field_docs(command).items():
            help_text = with_pages(" ".join(text.split()))
            annotation = Annotated[command.__annotations__[name], arg(help=help_text)]
            command.__annotations__[name] = annotation


def optional(metavar: str, hint: str | None = None) -> Any:
    """Return the help of an option that may be missing: the name of its value, and the text after
    the help, by default its default.
    """
    return arg(metavar=metavar, help_behavior_hint=hint)


DisplayExposure = Annotated[float | None, arg(metavar="STOPS", help=_STOPS)]
"""Option of the commands that render a stream."""


def place(metavar: str) -> Any:
    """Return the help of a positional argument for an output that has a default place."""
    return arg(metavar=f"[{metavar}]")


def setting(option: str, config: StreamConfig = _DEFAULTS, metavar: str = "") -> Any:
    """Return the help of an option that is None where it is not given: the name of its value, by
    default its type, and the default.
    """
    default = reduce(getattr, SETTINGS[option].split("."), config)
    metavar = metavar or type(default).__name__.upper()
    return arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


def one_command(commands: Mapping[str, type]) -> Any:
    """Return the annotation of an argument that is one of several commands, by their names."""
    union: Any = reduce(
        or_, (Annotated[command, subcommand(name)] for name, command in commands.items())
    )
    return arg(name="", constructor=union)


def _offsets(words: list[str]) -> dict[str, float]:
    """Return the offset of each camera from the words of --offset, a camera and a number in turn.

    Raises:
        ValueError: a word is missing, is no number, or names a camera a second time.
    """
    offsets: dict[str, float] = {}
    with suppress(ValueError):
        pairs = zip(words[::2], words[1::2], strict=True)
        offsets = {name: float(number) for name, number in pairs}
    if not words or 2 * len(offsets) != len(words):
        raise ValueError(
            "expected each camera once, with a number of frames, such as cam01 -0.5, got "
            f"{' '.join(words) or 'nothing'}."
        )
    return offsets


_OFFSETS = PrimitiveConstructorSpec(
    nargs="*",
    metavar="CAMERA FLOAT ...",
    instance_from_str=_offsets,
    is_instance=lambda value: isinstance(value, dict),
    str_from_instance=lambda value: [word for pair in value.items() for word in map(str, pair)],
)


@options
class Reading:
    """Options for differences between the clips of a capture: the fields of `ReadConfig`."""

    trim: Flag = False
    """Use the timestamps that all clips contain, at their lowest frame rate."""
    offset: Annotated[dict[str, float], _OFFSETS] = field(default_factory=dict)
    """Frame of a camera's clip, whole or not, that shows frame 0 of the others; negative if it
    began later.
    """
    gaps: Flag = False
    """Continue where images are missing, without their cameras."""
    exclude: Without = ()
    """Cameras that are left out, by name."""
    near: Annotated[float | None, optional("UNITS", "(default: from the scene)")] = None
    """Depth of the cameras' near planes (docs/captures.md)."""

    def read_config(self) -> ReadConfig:
        """Return the options as `load_capture` takes them."""
        values = asdict(self)
        return ReadConfig(without=values.pop("exclude"), **values)


@options
class Settings:
    """Settings of a fit. Later ones override: defaults, --preset, --config, the other options."""

    refine_cameras: Annotated[str | None, setting("refine_cameras", metavar="MODE")] = None
    """Refinement of the cameras: off, on, or auto (if withheld pixels gain)."""
    exposure: Annotated[str | None, setting("exposure", metavar="MODE")] = None
    """Estimation of exposures and white balances: off, on, or auto (between cameras if withheld
    pixels gain).
    """
    num_gaussians: Annotated[int | None, optional("INT", "(default: by detail and time)")] = None
    """Gaussians of the first frame."""
    first_frame_steps: Annotated[
        int | None, optional("INT", "(default: by Gaussians and time)")
    ] = None
    """Optimisation steps of the first frame."""
    first_frame_seconds: float | None = None
    """Time that the first frame may take on this machine; by default its Gaussians and steps take
    120 s on two cores.
    """
    sh_degree: Annotated[int | None, setting("sh_degree")] = None
    """Degree of the spherical harmonics, 0 to 3."""
    epochs: Annotated[int | None, setting("epochs")] = None
    """Passes over the views for every later frame."""
    flow: Annotated[str | None, setting("flow", metavar="METHOD")] = None
    """Optical flow: a method, files:FOLDER or onnx:FILE (docs/flow.md)."""
    masks: Annotated[str | None, setting("masks", metavar="METHOD")] = None
    """Refinement of the motion masks (docs/masks.md)."""
    quality: Annotated[float | None, setting("quality")] = None
    """Precision of the stream; 2 halves all errors."""
    target_size: Annotated[int | None, setting("target_size")] = None
    """Most bytes of a later frame; 0: no limit."""
    preset: Annotated[str | None, optional("NAME")] = None
    """Preset: l, s (the paper's variants, 8 and 5 epochs), paper (its scheme), baseline, or ml,
    ml-mo, ml-mo-mc (its ablation).
    """
    config: Annotated[Path | None, optional("FILE.toml")] = None
    """File with any settings, as --print-config writes it."""
    seed: Annotated[int | None, setting("seed")] = None
    """Seed of every random choice."""

    def given(self) -> dict[str, Any]:
        """Return the settings that were given as options, by key."""
        return {
            key: value
            for option, key in SETTINGS.items()
            if (value := getattr(self, option)) is not None
        }

    def stream_config(self, config: StreamConfig = _DEFAULTS) -> StreamConfig:
        """Return a config with the preset, the file and the given options applied.

        Raises:
            FileNotFoundError: the file, or what a setting names, is missing.
            ValueError: a setting is unknown, of the wrong type or out of range.
        """
        if self.preset is not None:
            config = apply_preset(config, cast(PresetName, self.preset))
        if self.config is not None:
            config = apply_values(config, read_config(self.config), self.config)
        for key, value in self.given().items():
            tables = reduce(lambda inner, name: {name: inner}, reversed(key.split(".")), value)
            config = apply_values(config, tables)
        return config

    def check_methods(self, config: StreamConfig) -> None:
        """Check the methods that a config names, and load their networks, before a fit begins.

        Raises:
            FileNotFoundError: one of them names a missing file or folder.
            ValueError: one of them is unknown, or its network does not fit.
        """
        from morgs_mi.method.flow_sources.flow_registry import FLOW_SOURCES
        from morgs_mi.method.mask_refiners.mask_registry import MASK_REFINERS
        from morgs_mi.method.motion_model import MOTION_MODELS

        motion = config.motion
        FLOW_SOURCES.make(motion.flow_method, motion.flow)
        MASK_REFINERS.make(motion.mask_method, motion.masks)
        MOTION_MODELS.make(motion.model, motion)


# As fields of a command: options without a prefix. None means "not given", so it cannot be passed.
GivenReading = Annotated[Reading, arg(name="")]
GivenSettings = Annotated[Settings, arg(name="")]
