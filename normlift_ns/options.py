"""Everything that a user can choose, as plain dataclasses. Imports nothing heavy, so that --help is quick.

The docstring under a field is the help of its flag.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from normlift_ns.ranges import check_options, check_texts

RasterizeMode = Literal["classic", "antialiased"]
"""How a scene was rasterized in its training; splatfacto's `rasterize_mode`."""
BackendName = Literal["auto", "triton", "gsplat", "numba", "torch"]
"""What rasterizes; see `normlift_ns.rasterize_evidence`."""
KNOWN_RULES = ("1.4", "1.5", "1.6")
"""Versions of gsplat that draw differently."""
GsplatRules = Literal["auto", "1.4", "1.5", "1.6", "installed"]
"""By which of them a scene is drawn."""
Background = Literal["black", "white"]
"""What is behind a splat without a nerfstudio run."""
Storage = Literal["evidence", "float16", "low_rank"]
"""How directions are stored: the evidence itself (exact), float16, or float16 coordinates in a basis."""
Rule = Literal["cosine", "lerf", "margin"]
"""How the relevancy of a text follows from cosines; see `normlift_ns.relevancy`."""
Unlabeled = Literal["ignore", "dilute"]
"""What a pixel without a region counts as: nothing at all, or an observation of the zero vector."""

RegionsName = Literal["auto", "sam", "sam3", "patches", "superpixel", "grid", "files"]
FeaturesName = Literal["none", "langsplat"]
SamPrecision = Literal["auto", "float32", "float16", "bfloat16"]
Fill = Literal["black", "white"]
Missing = Literal["error", "skip"]

DEFAULT_MODEL, DEFAULT_PRETRAINED = "ViT-B-16", "laion2b_s34b_b88k"
"""Of OpenCLIP."""
DEFAULT_SAM, DEFAULT_SAM3 = "facebook/sam-vit-huge", "facebook/sam3"
CANONICAL_NEGATIVES = ("object", "things", "stuff", "texture")
"""Negative prompts of LERF."""
BACKGROUND_WORDS = ("floor", "wall", "ceiling", "background", "object", "things", "stuff", "texture")
"""Background prompts of the LERF-OVS protocol (section "Mask thresholding" of the paper)."""


class RuleFacts(NamedTuple):
    """What belongs to a rule besides its formula, which is in `core.query` for torch and in `quick` for numpy."""

    threshold: float
    """Relevancy above which a Gaussian is selected."""
    compares: bool
    """Whether it needs negatives."""
    least: float
    """Relevancy of a Gaussian without a direction: no threshold selects it."""
    faintest: float
    """Relevancy below which pictures tell nothing apart."""
    present: float | None
    """Top relevancy below which a text is probably not in the scene; None: that depends on the encoder."""


RULES: dict[Rule, RuleFacts] = {
    # the threshold suits the colour encoder, and questions of which nothing is known: see `question.make_question`
    "cosine": RuleFacts(0.5, compares=False, least=0.0, faintest=0.0, present=None),
    # the threshold is a draw
    "lerf": RuleFacts(0.5, compares=True, least=0.0, faintest=0.0, present=0.62),
    # the threshold is the paper's; a text is present by the same lead over the negatives as with lerf
    "margin": RuleFacts(0.02, compares=True, least=-2.0, faintest=-0.1, present=math.log(0.62 / (1 - 0.62)) / 10),
}
VoteKind = Literal["paper", "posterior"]
"""How a vote weighs what a Gaussian has seen itself against its neighbours; see `normlift_ns.refine`."""
WithoutDirection = Literal["none", "first"]
"""Class of a Gaussian without a direction, where one is scored: none, or the first."""
REACH, MIN_SIZE = 4.0, 20
"""How far apart Gaussians of one object may be, in units of the selection's median spacing, and how many it needs."""
ARRAY_FILES = ("coord.npy", "segment.npy", "instance.npy", "names.json")
"""Of labels as arrays."""
TRANSFER_DISTANCE = 6.0
"""How far a point may be from the Gaussian that labels it, in units of the scene's median spacing."""
OBJECT_FILES = ("objects.json", "objects.csv", "objects.ply", "objects_scene.ply")
"""Of a catalogue: all of it, its table, and the boxes in the coordinates of the capture and in those of the scene."""
FLOATER_LIMIT = 1.9
"""Score above which a Gaussian is a likely floater, see `insight.floaters`."""


@dataclass(frozen=True)
class SourceOptions:
    """What the images show: an encoder, and the regions that it looks at.

    Raises:
        ValueError: a value of another type or out of its range.

    >>> from normlift_ns import LiftOptions, SourceOptions, lift_run
    >>> source = SourceOptions(encoder="colour", regions="grid", region_count=192)
    >>> run = lift_run(config, source=source, lift=LiftOptions(max_views=3), output_dir=folder)
    >>> run.field.manifest["encoder"]["encoder"], run.ask("red")["red"].peak > 0.9
    ('colour', True)
    """

    encoder: str = "open_clip"
    """open_clip: CLIP features of masked crops, or of patches. siglip, siglip2, metaclip2: the same with networks of
    the transformers library. colour: mean colours against colour names, without learned weights. Or the name of an
    encoder of another package."""
    encoder_model: str = DEFAULT_MODEL
    """open_clip: architecture. siglip, siglip2, metaclip2: a name on the Hugging Face hub or a folder, by default
    google/siglip-base-patch16-224, google/siglip2-base-patch16-224, facebook/metaclip-2-worldwide-huge-quickgelu."""
    encoder_pretrained: str = DEFAULT_PRETRAINED
    """Weights of the open_clip encoder: a tag to download, or a local file of that architecture."""
    crop_fill: Fill = "black"
    """Colour around a region in the crop that a network sees."""
    text_template: str = "{}"
    """What a network reads for a text, which takes the place of {}, such as "a photo of a {}". ensemble: the mean of
    seven templates of OpenCLIP. By default the bare text."""
    regions: RegionsName = "auto"
    """sam: SAM's masks. sam3: what SAM 3 finds for the texts of --queries. patches: the patches of a vision
    transformer, each with a feature of its own. superpixel: SLIC superpixels. grid: squares. files: label maps from
    --regions-dir. auto: files if --regions-dir is given, sam if --sam-model is. Otherwise, where a network sees the
    images, sam on a GPU if its weights are on this machine, else patches if the network has them; else superpixel."""
    region_texts: tuple[str, ...] = ()
    """What --regions sam3 looks for. By default the texts of --queries."""
    region_count: int | None = None
    """Approximate number of regions per image. By default 256 for superpixel and grid, 1024 for patches."""
    sam_model: str | None = None
    """Weights of SAM, SAM 2 or HQ-SAM: a folder in the format of transformers, a file of the first SAM published by
    Meta, or a name to download, such as facebook/sam2.1-hiera-large. By default facebook/sam-vit-huge, as LangSplat
    uses. With --regions sam3 those of SAM 3, by default facebook/sam3."""
    sam_precision: SamPrecision = "auto"
    """Precision of the network. auto: float16 on a GPU, float32 elsewhere."""
    regions_dir: Path | None = None
    """Folder with one label map per image, PNG or NPY with the same stem."""
    regions_background: int = 0
    """The value in label maps that means no region. Negative values never mean one."""
    regions_resample: bool = False
    """Resize label maps of another size to the image's by nearest neighbour, instead of refusing them."""
    level: str | None = None
    """Which level of regions counts. files: the number of a map in NPY files [levels, H, W]. sam and langsplat: s, m or
    l (subparts, parts, wholes; l by default), or default (all of SAM's masks in one map). langsplat also knows sum (the
    vectors of all levels added up)."""
    features: FeaturesName = "none"
    """Take regions and features from --features-dir instead of looking at images. langsplat: files of LangSplat's
    preprocessing."""
    features_dir: Path | None = None
    """Folder of the features."""
    features_missing: Missing = "error"
    """What to do about images without features: error, or skip to leave them out of the lift."""
    text_vectors: Path | None = None
    """NPZ file, text -> vector, to look texts up in instead of encoding them. For imported features."""

    def __post_init__(self) -> None:
        check_options(self)
        check_texts("region_texts", self.region_texts)

    def looking_for(self, queries: Sequence[str]) -> SourceOptions:
        """The same options, with the texts that regions of sam3 are made of where none are given."""
        asked = self.regions == "sam3" and len(self.region_texts) == 0
        return replace(self, region_texts=tuple(queries)) if asked else self


@dataclass(frozen=True)
class SplatOptions:
    """Cameras and photographs of a splat that no nerfstudio run holds.

    Raises:
        ValueError: a value of another type or out of its range.

    >>> from normlift_ns import SplatOptions
    >>> SplatOptions(transforms="capture/transforms.json").views
    'train'
    """

    colmap: Path | None = None
    """Folder of a COLMAP project, with images/ and sparse/0/ in it."""
    transforms: Path | None = None
    """transforms.json of nerfstudio, instant-ngp or Blender, instead of --colmap."""
    images: Path | None = None
    """Folder of the photographs, or of smaller copies such as images_4. By default images/ of the COLMAP project, or
    where transforms.json says."""
    masks: Path | None = None
    """Folder with one mask per photograph, zero where a pixel does not count."""
    world_transform: Path | None = None
    """File of the similarity from the world of the cameras to that of the splat: 4 x 4 numbers, or the
    dataparser_transforms.json of the run that a PLY file was exported from. By default the worlds are the same."""
    gsplat_normalize: bool = True
    """gsplat's trainer normalized the world (its default); computed again from the COLMAP project. A PLY file is
    taken for one of that trainer only where its photographs say so."""
    views: Literal["train", "all"] = "train"
    """train: lift the photographs that were not held out. all: lift all of them."""
    test_every: int | None = None
    """Every n-th photograph, from the first on, was held out of the training: 8 for gsplat's trainer, and for Inria's
    with --eval. By default none, or those that transforms.json names."""
    holdout: tuple[str, ...] = ()
    """Photographs held out of the training, instead of --test-every: their names, a text file of names, or a share such
    as 0.1, which ns-train holds out by default."""
    rasterize_mode: RasterizeMode | None = None
    """How the splat was rasterized in its training: classic or antialiased. By default as the PLY file says, else
    classic."""
    background: Background = "black"
    """What is behind the splat, and behind photographs with an alpha channel."""

    def __post_init__(self) -> None:
        if isinstance(self.holdout, str | float):
            object.__setattr__(self, "holdout", (str(self.holdout),))
        check_options(self)


class VoteNumbers(NamedTuple):
    """The parameters whose defaults depend on the kind of vote."""

    sigma_d: float
    tau: float
    gamma: float
    delta: float


VOTES: dict[VoteKind, VoteNumbers] = {
    "posterior": VoteNumbers(sigma_d=2.0, tau=0.9, gamma=0.05, delta=0.0),
    "paper": VoteNumbers(sigma_d=1.0, tau=0.95, gamma=0.4, delta=0.0),
}
"""The defaults of each kind of vote; the help of the fields of `RefineConfig` repeats them."""


@dataclass(frozen=True)
class RefineConfig:
    """Parameters of the vote among neighbours.

    The paper publishes no values. The defaults were chosen where the truth is known: see docs/accuracy.md. What suits
    one kind of vote does not suit the other, so that a parameter that is None takes the default of its kind.

    Raises:
        ValueError: a value outside its range.

    >>> from normlift_ns import RefineConfig
    >>> RefineConfig(vote="paper", k=12).numbers.sigma_d, RefineConfig(vote="posterior").numbers.sigma_d
    (1.0, 2.0)
    """

    vote: VoteKind = "posterior"
    """How the vote weighs what a Gaussian has seen itself. posterior: by the views that saw it, against --prior views
    of the neighbourhood. paper: as one voter among its neighbours (equations 9 and 10 of the paper)."""
    k: int = 36
    """Number of neighbours K in the vote, at least 1."""
    sigma_d: float | None = None
    """Width of the vote's spatial decay, > 0. The unit is the scene's median distance from a Gaussian to the nearest
    one at another place, because scenes are rescaled. By default 2 for posterior, 1 for paper."""
    tau: float | None = None
    """Cosine at which two directions half agree in the vote, in -1..1. By default 0.9 for posterior, 0.95 for
    paper."""
    gamma: float | None = None
    """Softness of that agreement, > 0. By default 0.05 for posterior, 0.4 for paper."""
    delta: float | None = None
    """Margin Delta by which the best neighbour must win the vote, >= 0. By default 0."""
    prior: float = 4.0
    """What all neighbours together count in a posterior vote, in views, >= 0."""

    def __post_init__(self) -> None:
        check_options(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Configs of version 0.1 know one kind of vote."""
        vars(self).update({"vote": "paper", **state})

    @property
    def numbers(self) -> VoteNumbers:
        """The parameters, with the defaults of this kind of vote where none are given."""
        given = {name: getattr(self, name) for name in VoteNumbers._fields}
        return VOTES[self.vote]._replace(**{name: value for name, value in given.items() if value is not None})


@dataclass(frozen=True)
class LiftOptions:
    """What to lift and how.

    Raises:
        ValueError: a value of another type or out of its range.

    >>> from normlift_ns import LiftOptions
    >>> LiftOptions(max_views=8).storage
    'auto'
    """

    image_source: Literal["photos", "render"] = "photos"
    """What the encoder sees: the photographs, or the trained scene rendered from their cameras."""
    max_views: int | None = None
    """Use at most this many training views, evenly spread. By default all."""
    lift_downscale: int = 1
    """Divide the size of images and cameras by this number."""
    beta: float = 1.0
    """Strength of the prior in the reliability, in virtual views."""
    unlabeled: Unlabeled = "ignore"
    """Pixels without a region: ignore them, or let them dilute as observations of nothing."""
    weight_power: Literal[1, 2] = 1
    """1: weights A_ij as in the paper. 2: their squares."""
    consensus: bool = True
    """Before the lift, give every region the feature that the regions of other views agree on which hold the same
    Gaussians."""
    consensus_power: float = 1.0
    """How little a region counts for another one of which it shows more: the power of the share of it that lies there,
    >= 0. For --consensus True."""
    consensus_sample: int = 50
    """Gaussians that the consensus looks at in every region, or all that it has. For --consensus True."""
    consensus_least: float = 0.4
    """Agreement of regions across views, in 0..1, up to which they count as overlapping by chance and keep their
    features. Give 0 if your masks show things, however badly. For --consensus True."""
    refine: bool = True
    """Let a vote among neighbours repair directions: a Gaussian copies the one that wins."""
    vote: RefineConfig = field(default_factory=RefineConfig)
    tolerance: float = 1e-3
    """Largest error that storage may add to any cosine."""
    storage: Storage | Literal["auto"] = "auto"
    """How directions are stored: evidence (exact), float16, or low_rank (coordinates in a basis). auto: the smallest
    within the tolerance."""
    precision: Literal["standard", "double"] = "standard"
    """standard: float32, summed in float64 where digits cancel. double: float64 throughout, slow on a GPU."""
    backend: BackendName = "auto"
    """What rasterizes. triton: our own kernels, on a GPU. gsplat: its compiled kernels, on a GPU. numba: compiled for
    the CPU. torch: any device, slow. auto: the fastest for the device and the precision."""
    gsplat_rules: GsplatRules = "auto"
    """Version of gsplat whose rules of drawing count, because they say which weights a scene was trained with.
    installed: those of the gsplat on this machine. auto: those recorded with the scene, else 1.4. 1.6 is not released
    yet; its rules may change."""
    reuse_evidence: bool = True
    """Reuse cached 2D features and evidence of earlier lifts where they fit."""

    def __post_init__(self) -> None:
        check_options(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Configs of version 0.1 call `storage` `form`, and know no consensus."""
        known = {"storage" if name == "form" else name: value for name, value in state.items()}
        vars(self).update({"consensus": False, **known})


@dataclass(frozen=True)
class AskOptions:
    """How texts are compared with the scene, and what counts as found.

    Raises:
        ValueError: a value of another type or out of its range, an empty text.
    """

    negatives: tuple[str, ...] | None = None
    """Texts to compare with. By default as the encoder says: LERF's (object, things, stuff, texture) for networks, none
    for colour."""
    rule: Rule | Literal["auto"] = "auto"
    """How relevancy is computed. cosine: the cosine itself. lerf: against each negative. margin: above the best
    negative. auto: as the encoder says, which is lerf with negatives, else cosine."""
    threshold: float | Literal["auto"] | None = None
    """Relevancy above which a Gaussian is selected. auto: what the histogram of the relevancies suggests. By default
    as the encoder says, else 0.5 for lerf, 0.02 for margin, and auto for cosines; of the colour encoder 0.5."""
    min_reliability: float = 0.0
    """Minimum reliability of a selected Gaussian, in 0..1."""
    refined: bool = True
    """Use refined features."""
    text_vectors: Path | None = None
    """NPZ file, text -> vector, to look texts up in instead of the encoder that the run was lifted with."""
    text_template: str | None = None
    """What a network reads for a text, which takes the place of {}, such as "a photo of a {}". ensemble: the mean of
    seven templates of OpenCLIP. By default as the run was lifted."""

    def __post_init__(self) -> None:
        check_options(self)
        check_texts("negatives", self.negatives or ())

    def rules(self) -> dict[str, Any]:
        """As `LiftedRun.ask` takes them: all but what says who reads the texts."""
        return {name: value for name, value in vars(self).items() if not name.startswith("text_")}
