"""Benchmarks, which print ratios from single runs. They are not tests and do not fail by timing."""
