"""Old import path of the model classes, in config.yml files of version 0.1."""

from normlift_ns.nerfstudio_plugin.model import NormLiftModel, NormLiftModelConfig

__all__ = ["NormLiftModel", "NormLiftModelConfig"]
