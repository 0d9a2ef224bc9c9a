"""Method specifications of nerfstudio; shipped as normlift_ns.method_configs."""
