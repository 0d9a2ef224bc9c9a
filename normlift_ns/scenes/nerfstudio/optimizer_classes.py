"""Mirrors of nerfstudio's configuration classes for optimizers and schedulers; see `classes`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from normlift_ns.scenes.nerfstudio.targets import Target, target


@dataclass
class OptimizerConfig:
    """Mirror of nerfstudio's OptimizerConfig."""

    _target: Target = field(default_factory=target("torch.optim.adam.Adam"))
    lr: float = 0.0005
    eps: float = 1e-08
    max_norm: float | None = None


@dataclass
class AdamOptimizerConfig(OptimizerConfig):
    """Mirror of nerfstudio's AdamOptimizerConfig."""

    weight_decay: float = 0


@dataclass
class RAdamOptimizerConfig(OptimizerConfig):
    """Mirror of nerfstudio's RAdamOptimizerConfig."""

    _target: Target = field(default_factory=target("torch.optim.radam.RAdam"))
    weight_decay: float = 0


@dataclass
class SchedulerConfig:
    """Mirror of nerfstudio's SchedulerConfig."""

    _target: Target = field(default_factory=target("nerfstudio.engine.schedulers.Scheduler"))


@dataclass
class MultiStepSchedulerConfig(SchedulerConfig):
    """Mirror of nerfstudio's MultiStepSchedulerConfig."""

    _target: Target = field(default_factory=target("nerfstudio.engine.schedulers.MultiStepScheduler"))
    max_steps: int = 1000000
    gamma: float = 0.33
    milestones: tuple[int, ...] = (500000, 750000, 900000)


@dataclass
class ExponentialDecaySchedulerConfig(SchedulerConfig):
    """Mirror of nerfstudio's ExponentialDecaySchedulerConfig."""

    _target: Target = field(default_factory=target("nerfstudio.engine.schedulers.ExponentialDecayScheduler"))
    lr_pre_warmup: float = 1e-8
    lr_final: float | None = None
    warmup_steps: int = 0
    max_steps: int = 100000
    ramp: Literal["linear", "cosine"] = "cosine"


@dataclass
class CosineDecaySchedulerConfig(SchedulerConfig):
    """Mirror of nerfstudio's CosineDecaySchedulerConfig."""

    _target: Target = field(default_factory=target("nerfstudio.engine.schedulers.CosineDecayScheduler"))
    warm_up_end: int = 5000
    learning_rate_alpha: float = 0.05
    max_steps: int = 300000
