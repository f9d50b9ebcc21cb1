"""Iterative adaptive sampling as [IAS] prints it, kept to be compared with: ``with as_printed(): mi.render(...)``."""

from __future__ import annotations

from contextlib import contextmanager
from unittest.mock import patch

import numpy as np

from vpl.direct import adaptive
from vpl.direct.passes import SiteEstimates, SitePasses

_LEAST_VARIANCE = 0.01  # of a pass, relative to the mean over sites


class PrintedEstimates(SiteEstimates):
    """Estimates of passes that are weighted by the inverse of their variances (eq. 7, 8)."""

    most_samples = 20_000

    def _weights(self, samples, variance, weight):
        # A pass that saw nothing has no variance: it counts as much as one with little
        typical = np.mean(variance * samples) / samples
        return 1 / np.maximum(variance, np.maximum(_LEAST_VARIANCE * typical, np.finfo(np.float32).tiny))


class PrintedPasses(SitePasses):
    """Passes that know nothing of a cluster but its samples."""

    prior = 0.0

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.estimates = PrintedEstimates(*arguments)

    def _evaluate_importance(self, two_sided):
        """Clusters are alike."""


@contextmanager
def as_printed():
    """``adaptivedirect`` renders with :class:`PrintedPasses`, and no cluster may be coarse because it is faint."""
    with patch.multiple(adaptive, SitePasses=PrintedPasses, FAINT_SHARE=0.0):
        yield
