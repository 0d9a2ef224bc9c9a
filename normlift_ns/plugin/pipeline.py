"""Names that config.yml files of `ns-train normlift` of version 0.1 use."""

from normlift_ns.nerfstudio_plugin.pipeline import NormLiftPipeline, NormLiftPipelineConfig

__all__ = ["NormLiftPipeline", "NormLiftPipelineConfig"]
