"""Evaluation protocols and studies of ns-normlift-eval, described in docs/evaluation.md."""
