"""Names that config.yml files of version 0.1 use; the code is in `normlift_ns.nerfstudio_plugin`."""
