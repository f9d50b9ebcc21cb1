"""Iterative adaptive sampling exactly as printed in [IAS], for comparisons: ``with as_printed(): mi.render(...)``."""

from __future__ import annotations

from contextlib import contextmanager
from unittest.mock import patch

import numpy as np

from vpl.direct import adaptive
from vpl.direct.passes import SiteEstimates, SitePasses

_LEAST_VARIANCE = 0.01  # of a pass, relative to the mean over spatial cells


class PrintedEstimates(SiteEstimates):
    """Estimates of passes weighted by inverse variances (eq. 7, 8)."""

    most_samples = 20_000

    def _weights(self, samples, variance, weight):
        # A pass without contributions has no measured variance; it counts like a pass with the minimum variance
        typical = np.mean(variance * samples) / samples
        return 1 / np.maximum(variance, np.maximum(_LEAST_VARIANCE * typical, np.finfo(np.float32).tiny))


class PrintedPasses(SitePasses):
    """Passes that use no knowledge of a cluster except its samples."""

    prior = 0.0

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.estimates = PrintedEstimates(*arguments)

    def _evaluate_importance(self, two_sided):
        """Treat all clusters equally."""


@contextmanager
def as_printed():
    """Make ``adaptivedirect`` render with :class:`PrintedPasses`; faint clusters must be as fine as bright ones."""
    with patch.multiple(adaptive, SitePasses=PrintedPasses, FAINT_SHARE=0.0):
        yield
