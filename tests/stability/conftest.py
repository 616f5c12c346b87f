"""Hypothesis draws the same numbers on every run, so that a failure is a failure for everybody."""

from hypothesis import HealthCheck, settings

settings.register_profile(
    "same numbers", derandomize=True, deadline=None, database=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("same numbers")
