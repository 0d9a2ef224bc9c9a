"""Old import path of the pipeline classes, in config.yml files that `ns-train normlift` of version 0.1 wrote."""

from normlift_ns.nerfstudio_plugin.pipeline import NormLiftPipeline, NormLiftPipelineConfig

__all__ = ["NormLiftPipeline", "NormLiftPipelineConfig"]
