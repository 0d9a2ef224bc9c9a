"""Estimate of the time, memory and disk space of a lift, from a short measurement on this machine."""
