"""Old import paths in config.yml files of version 0.1; the code is in `normlift_ns.nerfstudio_plugin`."""
