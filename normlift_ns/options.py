"""Options of lifts, queries and exports, as dataclasses that check their values.

The dataclasses call `check_options` in `__post_init__`, which compares each value with its declared type and its range
in `OPTION_RANGES`. Commands, `ns-train normlift` and Python code therefore report invalid values before they load data.

This module imports no heavy package, to keep --help fast.
"""

from __future__ import annotations

import errno
import math
import os
import re
import sys
import types
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from normlift_ns.errors import InputError, PathError
from normlift_ns.registry import installed_names

_MAX_INT, _MAX_FLOAT = 2**31 - 1, 1e30
"""Default upper bounds of integer and float options. They prevent overflow in int32 and float32."""
_MIN_DIVISOR = 1e-6
"""Lower bound of most positive options, because some of these options are divisors."""
MAX_PROMPT_LENGTH = 10_000
"""Maximum number of characters in a prompt. CLIP encodes only about the first 70 words."""
_INVALID = re.compile("[\0\ud800-\udfff]")
"""Characters that prompts and text options must not contain: NUL, and surrogates, which UTF-8 cannot encode."""
_IMPOSSIBLE = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR)
"""Error numbers for a name that is too long, a loop of links, and a file that is used as a folder."""
_hints = cache(get_type_hints)
_MAX_SHOWN = 60
"""Maximum number of characters of a value that a message quotes."""


@dataclass(frozen=True)
class OptionRange:
    """Inclusive range of an option, with its description for messages."""

    low: float
    high: float
    description: str


def _at_least(low: int, high: int = _MAX_INT) -> OptionRange:
    return OptionRange(low, high, f"at least {low}" if high == _MAX_INT else f"in {low}..{high}")


_POSITIVE = OptionRange(_MIN_DIVISOR, _MAX_FLOAT, f"positive, at least {_MIN_DIVISOR:g}")
_OPTIONS_BY_RANGE = {
    _at_least(0): ("load_step",),
    _at_least(1): ("k", "max_views", "lift_downscale", "consensus_sample", "segment_views", "object_min_gaussians"),
    _at_least(1, 4096): ("num_devices",),
    _at_least(1, 2**20): ("region_count",),
    _at_least(1, 10**7): ("max_gaussians",),
    _at_least(2): ("test_every",),
    _at_least(3, 10**5): ("views",),
    _at_least(2000, 10**8): ("num_gaussians",),
    OptionRange(0.0, 1.0, "in 0..1"): (
        "consensus_min_agreement",
        "min_labeled",
        "min_reliability",
        "min_opacity",
        "purity",
    ),
    OptionRange(-1.0, 1.0, "in -1..1"): ("tau",),
    OptionRange(0.0, _MAX_FLOAT, "at least 0"): (
        "delta",
        "prior",
        "reliability_beta",
        "consensus_power",
        "min_weight",
    ),
    _POSITIVE: ("sigma_d", "gamma", "object_max_gap", "meters_per_unit", "transfer_distance"),
    OptionRange(1e-9, _MAX_FLOAT, "positive, at least 1e-09"): ("tolerance",),
    OptionRange(-_MAX_FLOAT, _MAX_FLOAT, "finite"): ("threshold", "floater_threshold", "margin"),
    OptionRange(-_MAX_INT, _MAX_INT, "a 32-bit integer"): ("regions_background",),
    OptionRange(1, 65535, "a port number, 1..65535"): ("port",),
    OptionRange(1.0, 86400.0, "in 1..86400"): ("patience",),
}
OPTION_RANGES = {name: limits for limits, names in _OPTIONS_BY_RANGE.items() for name in names}
"""Range of each numeric option, by name. All ranges exclude NaN and infinity."""

_show_flags: ContextVar[bool] = ContextVar("flags", default=False)


@contextmanager
def named_as_flags() -> Iterator[None]:
    """Make messages name options as flags (--vote-sigma-d) instead of fields (sigma_d) in this context."""
    token = _show_flags.set(True)
    try:
        yield
    finally:
        _show_flags.reset(token)


VOTE_FLAGS = {name: f"vote_{name}" for name in ("k", "sigma_d", "tau", "gamma", "delta", "min_labeled", "prior")}
"""Command-line names of the fields of `RefineConfig` except `vote`, with underscores and without leading dashes."""


def option_name(name: str) -> str:
    """Return the name of an option for a message: the field, or the flag inside `named_as_flags`.

    >>> option_name("sigma_d")
    'sigma_d'
    >>> with named_as_flags():
    ...     option_name("sigma_d")
    '--vote-sigma-d'
    """
    return f"--{VOTE_FLAGS.get(name, name).replace('_', '-')}" if _show_flags.get() else name


def option_setting(name: str, value: object) -> str:
    """Return an option with a value for a message: a keyword argument, or a flag inside `named_as_flags`.

    >>> option_setting("device", "cpu")
    "device='cpu'"
    >>> with named_as_flags():
    ...     option_setting("device", "cpu")
    '--device cpu'
    """
    return f"{option_name(name)} {value}" if _show_flags.get() else f"{name}={value!r}"


# Renamed options and keyword arguments. The old names work for one version, in Python and on the command line.


_Target = TypeVar("_Target")


def renamed(**names: str) -> Callable[[_Target], _Target]:
    """Accept old keyword arguments of a function, or old field names of a dataclass, with a DeprecationWarning.

    `__setstate__` accepts old names without a warning, because the config.yml files of earlier versions have them.

    Args:
        names: New names, keyed by old names.

    >>> @renamed(part="select")
    ... def export(select): return select
    >>> with warnings.catch_warnings(record=True) as given:
    ...     warnings.simplefilter("always")
    ...     export(part="rest"), str(given[0].message)
    ('rest', 'part is now select; the old name works in this version only')
    """

    def decorate(target: Any) -> Any:
        if not hasattr(target, "__dataclass_fields__"):
            return _accept_old_keywords(target, names)
        target.old_names = {**getattr(target, "old_names", {}), **names}
        target.__init__ = _accept_old_keywords(target.__init__, target.old_names)
        target.__getattr__ = _get_renamed
        restore = getattr(target, "__setstate__", lambda self, state: vars(self).update(state))
        target.__setstate__ = lambda self, state: restore(self, new_names(target, state))
        return target

    return decorate


def _accept_old_keywords(function: Callable[..., Any], names: Mapping[str, str]) -> Callable[..., Any]:
    @wraps(function)
    def accept(*args: Any, **kwargs: Any) -> Any:
        for old in names.keys() & kwargs.keys():
            _warn_renamed(old, names[old])
            kwargs[names[old]] = kwargs.pop(old)  # `replace` passes the new name too, with the value to replace
        return function(*args, **kwargs)

    return accept


def _get_renamed(self: Any, name: str) -> Any:
    if name not in type(self).old_names:
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
    _warn_renamed(name, type(self).old_names[name])
    return getattr(self, type(self).old_names[name])


def _warn_renamed(old: str, new: str) -> None:
    warnings.warn(f"{old} is now {new}; the old name works in this version only", DeprecationWarning, stacklevel=3)


def new_names(options: Any, stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return the stored values of an options dataclass, keyed by the field names of this version."""
    return {options.old_names.get(name, name): value for name, value in stored.items()}


def names_of_0_2(options: Any) -> dict[str, Any]:
    """Return options as a dictionary with the names of version 0.2.

    The capture keys of batches and the encoder entry of manifests still use these names.
    """
    old_names = {new: old for old, new in getattr(options, "old_names", {}).items()}
    values = {old_names.get(field.name, field.name): getattr(options, field.name) for field in fields(options)}
    if values.get("encoder") == "color":
        values["encoder"] = "colour"
    return {name: names_of_0_2(value) if is_dataclass(value) else value for name, value in values.items()}


def renamed_flags(options: Any, prefix: str = "--") -> dict[str, str]:
    """Return the renamed flags of an options dataclass and its groups, as a dictionary from old to new flags.

    Args:
        prefix: Prefix of the flags. With a prefix other than "--", the flags of `RefineConfig` have no old names.
    """
    names = VOTE_FLAGS if options is RefineConfig and prefix == "--" else getattr(options, "old_names", {})
    flags = {f"{prefix}{old}".replace("_", "-"): f"{prefix}{new}".replace("_", "-") for old, new in names.items()}
    for hint in filter(is_dataclass, _hints(options).values()):
        flags |= renamed_flags(hint, prefix)
    return flags


def rename_flags(words: Sequence[str], flags: Mapping[str, str]) -> list[str]:
    """Replace old flags in a command line with new ones, and print one line per old flag on standard error.

    Args:
        words: Command line. Words after "--" belong to another command and stay unchanged.
        flags: New flags, keyed by old flags.

    >>> rename_flags(["--beta=2", "--text_vectors", "a", "--", "--beta"], {"--beta": "--reliability-beta"})
    ['--reliability-beta=2', '--text_vectors', 'a', '--', '--beta']
    """
    end = [*words, "--"].index("--")
    parts = [word.partition("=") for word in words[:end]]
    found = {flag: flags[name] for flag, *_ in parts if (name := flag.replace("_", "-")) in flags}
    for old, new in found.items():
        _print_renamed(old, new)
    return [found.get(flag, flag) + equals + value for flag, equals, value in parts] + list(words[end:])


@cache
def _print_renamed(old: str, new: str) -> None:
    print(f"{old} is now {new}; the old name works in this version only.", file=sys.stderr)


def check_options(options: Any) -> None:
    """Check every field of an options dataclass against its declared type and its range.

    Lists become tuples, strings become paths and integers become floats if the field declares that type.

    Raises:
        InputError: A value has the wrong type or is out of range.
    """
    for name, hint in _hints(type(options)).items():
        object.__setattr__(options, name, _convert(name, getattr(options, name), hint))


class CheckedOptions:
    """Base class of options dataclasses. It checks the fields of each new instance with `check_options`."""

    def __post_init__(self) -> None:
        check_options(self)


def check_number(name: str, value: Any, kind: type[int] | type[float] = float) -> Any:
    """Check the value of a numeric option against `OPTION_RANGES`, and return it as int or float.

    Raises:
        InputError: The value is not a number, not finite, or out of range.

    >>> check_number("object_min_gaussians", 20, int), check_number("object_max_gap", 4)
    (20, 4.0)
    """
    integer = kind is int
    if isinstance(value, bool) or not isinstance(value, Integral if integer else Real):
        raise _error(name, f"a {'whole ' if integer else ''}number", value)
    bounds, number = OPTION_RANGES[name], cast(Any, value)
    if not bounds.low <= number <= bounds.high:  # also true for nan
        expected = bounds.description
        if expected == "finite" and -math.inf < number < math.inf:
            expected = f"in {bounds.low:g}..{bounds.high:g}"
        elif number > bounds.high and not expected.startswith("in "):
            expected = "finite" if number == math.inf else f"at most {bounds.high:{',' if integer else 'g'}}"
        raise _error(name, expected, value)
    return kind(number)


def check_bool(name: str, value: object) -> None:
    """Raise InputError unless the value is True or False. Strings are not converted, because even "False" is truthy."""
    if not isinstance(value, bool):
        raise _error(name, "True or False", value)


def check_device(device: Any) -> str:
    """Check the name of a device, and return it: auto, cpu, cuda, or cuda:1 for the second GPU.

    Raises:
        InputError: The name is not valid.

    >>> check_device("cuda:0")
    'cuda:0'
    """
    if not re.fullmatch(r"auto|cpu|cuda(:\d{1,3})?", str(device), re.ASCII):
        raise InputError(
            f"{option_name('device')} must be auto, cpu or cuda, or a GPU such as cuda:1; got {short_repr(str(device))}"
        )
    return str(device)


def check_prompt_list(name: str, texts: Sequence[str]) -> None:
    """Check a list of prompts, which may be empty.

    Args:
        name: Name of the option, for messages.
        texts: List of prompts.
    Raises:
        InputError: `texts` is a single string, or a prompt is not a string, or is empty, repeated or too long, or has
            an invalid character.
    """
    if isinstance(texts, str):
        raise InputError(f"{option_name(name)} must be a list of prompts, got the single prompt {short_repr(texts)}")
    previous: set[str] = set()
    for number, text in enumerate(texts, start=1):
        label = f"prompt {number} of {len(texts)} in {option_name(name)}"
        if not isinstance(text, str):
            raise InputError(f"{label} must be a string, got {short_repr(text)}")
        if text.strip() == "":
            raise InputError(f"{label} is empty ({short_repr(text)}); remove it, or write a prompt")
        if len(text) > MAX_PROMPT_LENGTH:
            raise InputError(f"{label} has {len(text):,} characters; shorten it to at most {MAX_PROMPT_LENGTH:,}")
        if _INVALID.search(text):
            raise InputError(f"{label} contains an invalid character ({short_repr(text)}); remove that character")
        if text in previous:
            raise InputError(f"{label}, {short_repr(text)}, is a duplicate; give each prompt only once")
        previous.add(text)


def short_repr(value: object) -> str:
    """Return the repr of a value for a message, cut after 60 characters, or the type if the repr fails.

    >>> short_repr("x" * 100)[-5:], short_repr(10**5000)
    ('xxx …', 'a number of type int')
    """
    try:
        text = repr(value)
    except Exception:  # from objects of other packages, or integers with thousands of digits
        return f"a number of type {type(value).__name__}" if isinstance(value, Real) else type(value).__name__
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]} …"


def _error(name: str, expected: str, value: object) -> InputError:
    return InputError(f"{option_name(name)} must be {expected}, got {short_repr(value)}")


def _convert(name: str, value: Any, hint: Any) -> Any:
    """Convert a value to the declared type of its field; raise InputError if that is not possible."""
    origin, choices = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return _convert_union(name, value, choices)
    if origin is Literal:
        return _check_choice(name, value, choices)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            raise _error(name, "a list", value)
        return tuple(_convert(name, item, choices[0]) for item in value)
    return _convert_scalar(name, value, hint)


def _convert_union(name: str, value: Any, choices: Sequence[Any]) -> Any:
    """Convert a value to one of several types: None, literal words, and at most one other type."""
    if value is None and type(None) in choices:
        return None
    words = [word for choice in choices if get_origin(choice) is Literal for word in get_args(choice)]
    others = [choice for choice in choices if get_origin(choice) is not Literal and choice is not type(None)]
    if len(others) == 0:  # Rule | Literal["auto"]
        return _check_choice(name, value, words)
    if isinstance(value, str) and value in words:
        return value
    if len(words) > 0 and others[0] is float and not isinstance(value, Real):
        raise _error(name, f"a number or {' or '.join(words)}", value)
    return _convert(name, value, others[0])


def _convert_scalar(name: str, value: Any, hint: type) -> Any:
    if hint in (int, float):
        return check_number(name, value, hint)
    if hint is Path:
        return check_path(name, value)
    if not isinstance(value, hint):
        raise _error(name, {bool: "True or False", str: "a string"}.get(hint, f"of type {hint.__name__}"), value)
    if hint is str and _INVALID.search(value):
        raise InputError(
            f"{option_name(name)} contains an invalid character ({short_repr(value)}); remove that character"
        )
    return value


def _check_choice(name: str, value: object, choices: Sequence[Any]) -> Any:
    for choice in choices:
        if type(value) is type(choice) and value == choice:
            return choice
    raise InputError(f"{option_name(name)} must be one of {', '.join(map(str, choices))}; got {short_repr(value)}")


def check_path(name: str, value: object) -> Path:
    """Check a string or a path, and return it as a Path, which need not exist.

    Args:
        name: Name of the option, for messages.
        value: String or path to check.
    Raises:
        InputError: The value has the wrong type, or contains NUL or a character that the file system cannot encode.
        PathError: A name is too long, the path leads through a file, or its links form a loop.

    >>> check_path("data", "fox").name
    'fox'
    """
    try:
        path = os.fspath(cast(Any, value))
    except TypeError:
        path = b""
    if not isinstance(path, str):
        raise _error(name, "a path", value)
    wrong = f"{option_name(name)} is not a valid path:"
    if "\0" in path:
        raise InputError(f"{wrong} it contains a NUL character ({short_repr(path)}); remove that character")
    try:
        os.stat(path)
    except UnicodeEncodeError:
        raise InputError(f"{wrong} the file system cannot encode {short_repr(path)}; give another path") from None
    except OSError as error:
        if error.errno in _IMPOSSIBLE:
            raise PathError(f"{wrong} {short_repr(path)} ({error.strerror}); give another path") from None
    return Path(path)


# Options that users set. The docstring under each field is the help text of its flag.


RasterizeMode = Literal["classic", "antialiased"]
"""Rasterization mode that a scene was trained with: splatfacto's `rasterize_mode`."""
BackendName = Literal["auto", "triton", "gsplat", "numba", "torch"]
"""Rasterization backend; see `normlift_ns.rasterize_evidence`."""
Primitive = Literal["3dgs", "2dgs"]
"""Kind of the trained Gaussians: 3D Gaussians, or the flat Gaussians of 2D Gaussian Splatting."""
GSPLAT_VERSIONS = ("1.4", "1.5", "1.6")
"""gsplat versions with different rasterization rules."""
GsplatVersion = Literal["auto", "1.4", "1.5", "1.6", "installed"]
"""gsplat version whose rasterization rules to apply."""
Background = Literal["black", "white"]
"""Background color of a splat that has no nerfstudio run."""
Storage = Literal["evidence", "float16", "low_rank"]
"""Storage format of directions: exact evidence, float16 vectors, or float16 coordinates in a low-rank basis."""
RelevancyRule = Literal["contrast", "cosine", "lerf", "margin"]
"""Formula that computes the relevancy of a prompt from cosines; see `normlift_ns.relevancy`."""
UnlabeledMode = Literal["ignore", "dilute"]
"""Treatment of pixels without a region: ignored, or counted as observations of the zero vector."""

RegionKind = Literal["auto", "sam", "sam3", "edges", "patches", "superpixel", "grid", "files"]
"""Built-in values of --regions."""
MASK_GROUP = "normlift_ns.masks"
"""Entry point group of mask sources; their names are further values of --regions."""
FeatureKind = Literal["none", "langsplat"]
SamPrecision = Literal["auto", "float32", "float16", "bfloat16"]
CropFill = Literal["black", "white"]
MissingFeatures = Literal["error", "skip"]

DEFAULT_MODEL, DEFAULT_PRETRAINED = "ViT-B-16", "laion2b_s34b_b88k"
"""Default OpenCLIP architecture and pretrained weights."""
DEFAULT_SAM, DEFAULT_SAM3 = "facebook/sam-vit-huge", "facebook/sam3"
CANONICAL_NEGATIVES = ("object", "things", "stuff", "texture")
"""Canonical negative prompts of LERF."""
BACKGROUND_WORDS = ("floor", "wall", "ceiling", "background", "object", "things", "stuff", "texture")
"""Background prompts of the LERF-OVS protocol (section "Mask thresholding" of the paper)."""
VoteKind = Literal["paper", "posterior"]
"""Kind of vote among neighboring Gaussians; see `RefineConfig`."""
ReliabilityKind = Literal["paper", "pairs", "angular"]
"""Kind of reliability to store; see `LiftOptions`."""
WithoutDirection = Literal["none", "first"]
"""Class that an evaluation assigns to Gaussians without a direction: no class, or the first class."""
OBJECT_MAX_GAP, OBJECT_MIN_GAUSSIANS = 4.0, 20
"""Default maximum gap within an object, in units of the selection's median spacing, and default minimum number of
Gaussians in an object."""
LABEL_ARRAY_FILES = ("coord.npy", "segment.npy", "instance.npy", "names.json")
"""Names of the files of exported label arrays."""
MAX_TRANSFER_DISTANCE = 6.0
"""Default maximum distance from a point to the Gaussian that labels it, in units of the scene's median spacing."""
CATALOG_FILES = ("objects.json", "objects.csv", "objects.ply", "objects_scene.ply")
"""Files of an object catalog: all values, the table, and boxes in capture and in scene coordinates."""
WEAK_RELIABILITY = 0.6
"""Reliability R below which the evidence of a Gaussian counts as weak."""
FLOATER_THRESHOLD = 1.9
"""Floater score above which a Gaussian is a likely floater; see `analysis.objects`."""


@renamed(text_template="prompt_template", text_vectors="text_embeddings", region_texts="sam3_prompts")
@dataclass(frozen=True)
class SourceOptions:
    """Options of the 2D features: the encoder, and the image regions that it encodes.

    Raises:
        ValueError: A value has the wrong type or is out of range.

    >>> from normlift_ns import LiftOptions, SourceOptions, lift_run
    >>> source = SourceOptions(encoder="color", regions="grid", region_count=192)
    >>> run = lift_run(config, source=source, lift=LiftOptions(max_views=3), output_dir=folder)
    >>> run.field.manifest["options"]["max_views"], run.ask("red")["red"].peak > 0.9
    (3, True)
    """

    encoder: str = "auto"
    """Encoder of regions and prompts. open_clip: CLIP, applied to masked crops or to patches. siglip, siglip2,
    metaclip2: networks of the transformers library, applied in the same way. imagenet: a small classifier; prompts are
    names of its 1,000 classes, or of groups of classes such as dog. Fetch its weights with ns-normlift-weights --get
    imagenet. color: mean colors, compared with color names; needs no weights. auto: open_clip with --features
    langsplat, or if --encoder-model, --encoder-pretrained or --prompt-template differs from its default. Otherwise,
    auto selects the first of open_clip, siglip2, siglip, metaclip2, imagenet and color whose default weights are on
    this machine. Any other name: an encoder from an installed plugin."""
    encoder_model: str = DEFAULT_MODEL
    """Network of the encoder. open_clip: the name of an architecture. siglip, siglip2, metaclip2: a Hugging Face model
    name or a local folder. Without this option, siglip uses google/siglip-base-patch16-224, siglip2 uses
    google/siglip2-base-patch16-224, and metaclip2 uses facebook/metaclip-2-worldwide-huge-quickgelu."""
    encoder_pretrained: str = DEFAULT_PRETRAINED
    """Pretrained weights for open_clip: a tag to download, or a local file for the same architecture."""
    crop_fill: CropFill = "black"
    """Color of the pixels of a crop that lie outside the region."""
    prompt_template: str = "{}"
    """Template of the text that the network encodes. {} stands for the prompt, as in "a photo of a {}". {} alone
    encodes the bare prompt. ensemble: average the vectors of seven OpenCLIP templates."""
    regions: str = "auto"
    """Image regions, each of which gets one feature. sam: masks of SAM. sam3: masks of SAM 3 for text prompts; see
    --sam3-prompts. edges: regions bounded by edges from a small network; fetch its weights with ns-normlift-weights
    --get edges. patches: patches of a grid, which the network encodes without masks. superpixel: pixels of similar
    color and position. grid: squares. files: label maps from --regions-dir. auto: files with --regions-dir, and sam
    with --sam-model. Otherwise, auto selects superpixel for the encoder color. For a neural network on a GPU, it
    selects the first of sam, edges and patches that this machine and the network support. If there is none, it selects
    superpixel. On a CPU, it does the same without sam, and prefers patches to edges if the network encodes each region
    as a crop, as CLIP does. Any other name: a mask source from an installed plugin."""
    sam3_prompts: tuple[str, ...] = ()
    """Prompts for the masks of --regions sam3. If there are none, SAM 3 uses the prompts of --queries."""
    region_count: int | None = None
    """Approximate number of regions per image for superpixel, grid, patches and edges. Larger values give smaller
    regions. None: 256 for superpixel and grid, 1024 for patches, and the number that --level sets for edges."""
    sam_model: str | None = None
    """Weights of SAM, SAM 2 or HQ-SAM: a folder in transformers format, a checkpoint of the original SAM, or a model
    name such as facebook/sam2.1-hiera-large. --regions sam3 needs weights of SAM 3. None: facebook/sam-vit-huge as in
    LangSplat, or facebook/sam3 for --regions sam3."""
    sam_precision: SamPrecision = "auto"
    """Floating-point precision of the SAM network. auto: float16 on a GPU, float32 otherwise."""
    regions_dir: Path | None = None
    """Folder with one label map per image: a PNG or NPY file with the same stem as the image."""
    regions_background: int = 0
    """Value of label map pixels that do not belong to a region. Pixels with negative values never belong to one."""
    regions_resample: bool = False
    """Resize label maps to the image size with nearest-neighbor sampling. False: stop with an error if the sizes
    differ."""
    level: str | None = None
    """Level of the regions. files: the index of the map in NPY files of shape [levels, H, W]. edges: s, m or l for
    about 300, 120 or 40 regions per image (None: m). sam and langsplat: s, m or l for subparts, parts or wholes (None:
    l), or default for all masks of SAM in one map. langsplat also accepts sum, which adds the vectors of all levels."""
    features: FeatureKind = "none"
    """Precomputed regions and features to use instead of encoding the images. langsplat: files in --features-dir that
    LangSplat's preprocessing wrote. none: encode the images."""
    features_dir: Path | None = None
    """Folder with the precomputed features that --features selects."""
    features_missing: MissingFeatures = "error"
    """Action if images have no precomputed features. error: stop. skip: leave these images out of the lift."""
    text_embeddings: Path | None = None
    """NPZ file with one vector per prompt, used instead of the text encoder. Needs --features langsplat."""

    def __post_init__(self) -> None:
        if self.regions not in get_args(RegionKind):
            plugins = [name for name in installed_names(MASK_GROUP) if name not in get_args(FeatureKind)]
            _check_choice("regions", self.regions, list(dict.fromkeys((*get_args(RegionKind), *plugins))))
        check_options(self)
        check_prompt_list("sam3_prompts", self.sam3_prompts)

    @classmethod
    def stored(cls, values: Mapping[str, Any]) -> SourceOptions:
        """Return the options recorded in a manifest, with field names of this version or of version 0.2."""
        return cls(**new_names(cls, values))

    def looking_for(self, queries: Sequence[str]) -> SourceOptions:
        """Return the options with `queries` as SAM 3 prompts if the regions are sam3 and no prompts are set."""
        missing = self.regions == "sam3" and len(self.sam3_prompts) == 0
        return replace(self, sam3_prompts=tuple(queries)) if missing else self


@renamed(holdout="eval_images")
@dataclass(frozen=True)
class SplatOptions:
    """Cameras and images of a splat that has no nerfstudio run.

    Raises:
        ValueError: A value has the wrong type or is out of range.

    >>> from normlift_ns import SplatOptions
    >>> SplatOptions(transforms="capture/transforms.json").views
    'train'
    """

    colmap: Path | None = None
    """Folder of a COLMAP project, such as one with images/ and sparse/0/."""
    transforms: Path | None = None
    """Camera file transforms.json of nerfstudio, instant-ngp or Blender, instead of --colmap."""
    images: Path | None = None
    """Folder of the images, or of smaller copies such as images_4. None: images/ of the COLMAP project, or the paths in
    transforms.json."""
    masks: Path | None = None
    """Folder with one mask per image. The lift ignores pixels with a mask value of zero. None: the masks that
    transforms.json names, if any."""
    world_transform: Path | Literal["auto"] | None = "auto"
    """Transform from the world of the cameras to that of the splat. auto: if the splat does not fit its images, search
    for a rotation, normalization or scaling that common tools apply. A path: a file with a similarity transform as a 4
    x 4 matrix, or the dataparser_transforms.json of the run that exported the PLY file. None: no search, and no
    transform except that of --gsplat-normalize."""
    gsplat_normalize: bool = True
    """For a splat from gsplat's trainer: assume that the trainer normalized the world, unless its cfg.yml records that
    it did not, and recompute the normalization from the COLMAP project. False: assume no normalization, whatever
    cfg.yml records. For other splats, --world-transform auto also tries this normalization."""
    views: Literal["train", "all"] = "train"
    """Images to lift. train: the images that were used for training. all: also images held out of training."""
    test_every: int | None = None
    """Interval n of held-out images: training left out every n-th image, starting with the first. gsplat's trainer and
    Inria's trainer with --eval use 8. None: as recorded in the cfg.yml of gsplat's trainer or, with --colmap, in the
    cfg_args of Inria's trainer. Without a record, the held-out images are those that transforms.json names, if any."""
    eval_images: tuple[str, ...] = ()
    """Images held out of training, instead of --test-every: image names, a text file of names, or the fraction of
    held-out images, such as 0.1, the default of ns-train."""
    rasterize_mode: RasterizeMode | None = None
    """Rasterization mode that the splat was trained with. None: as recorded in the file, in the cfg.yml of gsplat's
    trainer or in the cfg_args of Inria's trainer, else classic."""
    primitive: Primitive | None = None
    """Kind of the Gaussians. 2dgs: the flat Gaussians of 2D Gaussian Splatting, whose third scale is not used. None:
    2dgs if the PLY file has two scales, else the kind that gsplat's trainer recorded. Without a record, 2dgs if the
    file name contains 2dgs, else 3dgs."""
    background: Background | None = None
    """Background color behind the splat, and behind images with an alpha channel. None: as in the cfg_args of Inria's
    trainer, else black."""

    def __post_init__(self) -> None:
        if isinstance(self.eval_images, str | float):
            object.__setattr__(self, "eval_images", (str(self.eval_images),))
        check_options(self)


class VoteParameters(NamedTuple):
    """Vote parameters that have a default for each kind of vote."""

    sigma_d: float
    tau: float
    gamma: float
    delta: float
    min_labeled: float


VOTE_DEFAULTS: dict[VoteKind, VoteParameters] = {
    "posterior": VoteParameters(sigma_d=2.0, tau=0.9, gamma=0.05, delta=0.0, min_labeled=0.2),
    "paper": VoteParameters(sigma_d=1.0, tau=0.95, gamma=0.4, delta=0.0, min_labeled=0.0),
}
"""Default parameters of each kind of vote. The help texts of `RefineConfig` repeat them."""


@dataclass(frozen=True)
class RefineConfig(CheckedOptions):
    """Parameters of the vote among neighboring Gaussians.

    The paper publishes no values, so the defaults were tuned on scenes with ground truth; see docs/accuracy.md. A
    parameter that is None takes the default of the kind of vote. A lift may instead measure tau and gamma.

    Raises:
        ValueError: A value has the wrong type or is out of range.

    >>> from normlift_ns import RefineConfig
    >>> RefineConfig(vote="paper", k=12).numbers.sigma_d, RefineConfig(vote="posterior").numbers.sigma_d
    (1.0, 2.0)
    """

    vote: VoteKind = "posterior"
    """Weight of a Gaussian's own evidence in the vote. posterior: the effective number of views that agree on its
    direction; all neighbors together weigh as much as --vote-prior views. paper: one vote, as for each neighbor
    (equations 9 and 10 of the paper)."""
    k: int = 36
    """Number of neighbors K in the vote, at least 1. Larger values use a wider neighborhood and take longer. Values
    above 256 count as 256."""
    sigma_d: float | None = None
    """Width of the spatial decay of votes, > 0. Larger values give distant neighbors more weight. The unit is the
    median distance from a Gaussian to the nearest one at another position. None: 2 for posterior, 1 for paper."""
    tau: float | None = None
    """Cosine at which the agreement of two directions is one half, in -1..1. Larger values require more similar
    directions. None: 0.95 for paper. For posterior, a lift measures tau on pairs of neighbors that share a region. It
    uses 0.9 instead if there are fewer than 50 pairs or the consensus changed no features."""
    gamma: float | None = None
    """Softness of the agreement around the cosine --vote-tau, > 0. Larger values blur the distinction between similar
    and different directions. None: 0.4 for paper. For posterior, (1 - tau) / 2 if tau is measured, else 0.05."""
    delta: float | None = None
    """Margin Delta by which the best neighbor must win the vote, >= 0. Larger values change fewer Gaussians.
    None: 0."""
    min_labeled: float | None = None
    """Minimum share of a Gaussian's weight that must lie in regions for its direction to change, in 0..1. With larger
    values, objects without a mask take fewer directions from their neighbors. Gaussians that no view shows may always
    change. None: 0.2 for posterior, 0 for paper."""
    prior: float = 4.0
    """Weight of all neighbors together in a posterior vote, in views, >= 0. With larger values, the neighbors overrule
    even directions that many views support."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state. Configs of version 0.1 do not name the kind of vote, which was always the paper's."""
        vars(self).update({"vote": "paper", **state})

    @property
    def numbers(self) -> VoteParameters:
        """Vote parameters in which the defaults of this kind of vote replace None."""
        values = {name: getattr(self, name) for name in VoteParameters._fields}
        return VOTE_DEFAULTS[self.vote]._replace(**{name: value for name, value in values.items() if value is not None})


@renamed(beta="reliability_beta", consensus_least="consensus_min_agreement", gsplat_rules="gsplat_version")
@dataclass(frozen=True)
class LiftOptions(CheckedOptions):
    """Options of a lift: views, consensus, vote, storage and rasterization.

    Raises:
        ValueError: A value has the wrong type or is out of range.

    >>> from normlift_ns import LiftOptions
    >>> LiftOptions(max_views=8).storage
    'auto'
    """

    image_source: Literal["photos", "render"] = "photos"
    """Images that the encoder receives. photos: the training images. render: renders of the trained scene from the same
    cameras."""
    max_views: int | None = None
    """Maximum number of training views to lift, evenly spaced. More views take longer and give more reliable results.
    None: all."""
    lift_downscale: int = 1
    """Divisor of the width and height of images and cameras, at least 1. Larger values are faster and coarser."""
    reliability_beta: float = 1.0
    """Strength beta of the prior in the reliability R, as a number of views, >= 0. Larger values lower R, most for
    Gaussians with few views."""
    reliability: ReliabilityKind = "paper"
    """Reliability R to store. paper: equation 8 of the paper. pairs: agreement of pairs of views, so that a Gaussian
    with only one view has R <= 0.02. angular: as pairs, but views from nearby cameras count less. The vote always uses
    paper."""
    unlabeled: UnlabeledMode = "ignore"
    """Treatment of pixels without a region. ignore: leave them out. dilute: count them as observations of the zero
    vector."""
    weight_power: Literal[1, 2] = 1
    """Exponent of the rasterization weights A_ij: 1 as in the paper, or 2 for squared weights."""
    consensus: bool = True
    """Before the lift, move the features of regions toward those of regions in other views that cover the same
    Gaussians. This requires enough agreement between the views; see --consensus-min-agreement."""
    consensus_power: float = 1.0
    """Exponent on the overlap fraction in the consensus, >= 0. Larger values down-weight regions that cover more than
    the target region. Needs --consensus True."""
    consensus_sample: int = 50
    """Minimum number of Gaussians that the consensus samples in each region, at least 1. Regions with fewer Gaussians
    use all of them. Larger values are more exact and slower. Needs --consensus True."""
    consensus_min_agreement: float | None = None
    """Agreement of regions across views, in 0..1, that the scene must exceed for the consensus to change features. At
    lower agreement, overlaps may be random. Larger values disable the consensus in more scenes. Use 0 if each region
    shows roughly one object. None: 0 for masks of SAM and for regions between edges, 0.4 for others. Needs --consensus
    True."""
    recognition: bool = True
    """Measure how well a lift of half of the views recognizes the regions of the other half, and vice versa. Use the
    result to compare captures, encoders and settings without labels. The measurement does not change the lift, and
    takes a few seconds."""
    refine: bool = True
    """Repair directions by a vote among neighboring Gaussians. A Gaussian copies the direction of the neighbor that
    wins the vote, or keeps its own."""
    vote: RefineConfig = field(default_factory=RefineConfig)
    tolerance: float = 1e-3
    """Maximum error that --storage auto or low_rank may add to any cosine, > 0. Larger values allow smaller files."""
    storage: Storage | Literal["auto"] = "auto"
    """Storage format of directions. evidence: the exact evidence. float16: half-precision vectors. low_rank:
    coordinates in a low-rank basis. auto: the smallest format within --tolerance."""
    precision: Literal["standard", "double"] = "standard"
    """Floating-point precision of the lift. standard: float32, with float64 for sums that lose digits. double: float64
    throughout, which is slow on a GPU."""
    backend: BackendName = "auto"
    """Rasterization backend. triton: kernels of this package for a GPU. gsplat: kernels of gsplat for a GPU. numba:
    compiled code for the CPU. torch: PyTorch code for any device, which is slow. auto: the fastest backend that
    supports the device, the splat and the other options."""
    gsplat_version: GsplatVersion = "auto"
    """gsplat version whose rasterization rules the lift reproduces; it must be the version that trained the scene.
    installed: the version on this machine. auto: the version recorded with the scene, or else 1.4. Version 1.6 is not
    released yet and may still change."""
    reuse_evidence: bool = True
    """Reuse cached 2D features and evidence of earlier lifts if their inputs are the same."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore the state. Configs of version 0.1 have the name `form` for `storage`, and no consensus."""
        options = {"storage" if name == "form" else name: value for name, value in state.items()}
        vars(self).update({"consensus": False, **options})


@renamed(rule="relevancy", text_vectors="text_embeddings", text_template="prompt_template")
@dataclass(frozen=True)
class AskOptions:
    """Options of queries: the comparison of prompts with the scene, and the selection of Gaussians.

    Raises:
        ValueError: A value has the wrong type or is out of range, or a negative prompt is empty or repeated.
    """

    negatives: tuple[str, ...] | None = None
    """Negative prompts for the formulas lerf and margin. None: object, things, stuff and texture (from LERF).
    Encoders of plugins can have other defaults, which apply if the lift did not compare the scene with unrelated
    words."""
    relevancy: RelevancyRule | Literal["auto"] = "auto"
    """Relevancy formula. cosine: the cosine of prompt and Gaussian. contrast: the softmax against the cosine that 3% of
    unrelated words reach at the same Gaussian. lerf: the smallest softmax against one negative prompt. margin: the
    cosine minus the largest cosine of a negative prompt. auto: lerf if --negatives has prompts, and cosine if it is
    given without prompts. Without --negatives, contrast if the lift compared the scene with unrelated words, else lerf
    if the text encoder has default negatives, else cosine. Encoders of plugins may have another default."""
    threshold: float | Literal["auto"] | None = None
    """Relevancy above which a Gaussian is selected. Larger values select fewer Gaussians. auto: a threshold from the
    histogram of relevancies. None: 0.5 for contrast and lerf, 0.02 for margin, and auto for cosine. The encoder color
    uses 0.7 for cosine, and encoders of plugins may set their own default. Unless you give a number, prompts that are
    probably not in the scene select nothing."""
    min_reliability: float = 0.0
    """Minimum reliability of selected Gaussians, in 0..1. Larger values drop Gaussians that few views support."""
    refined: bool = True
    """Use the directions after the vote. False: use the directions before the vote."""
    text_embeddings: Path | None = None
    """NPZ file with one vector per prompt, used instead of the text encoder of the run."""
    prompt_template: str | None = None
    """Template of the text that the network encodes. {} stands for the prompt, as in "a photo of a {}". ensemble:
    average the vectors of seven OpenCLIP templates. None: the template of the lift."""

    def __post_init__(self) -> None:
        check_options(self)
        check_prompt_list("negatives", self.negatives or ())

    def rules(self) -> dict[str, Any]:
        """Return the keyword arguments for `LiftedRun.ask`, which are all options except those of `encoding`."""
        return {name: value for name, value in vars(self).items() if name not in self.encoding()}

    def encoding(self) -> dict[str, Any]:
        """Return the options that encode prompts, as keyword arguments for `open_run`."""
        return {"text_embeddings": self.text_embeddings, "prompt_template": self.prompt_template}
