"""Evaluation protocols of ns-normlift-eval: ScanNet, LERF-OVS and captures with instance masks. See
docs/evaluation.md."""
