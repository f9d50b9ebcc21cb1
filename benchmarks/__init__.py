"""Measurements that print ratios from one run.  They are not tests: nothing here passes or fails by the clock."""
