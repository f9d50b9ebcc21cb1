"""Passes of longer renders: passes of ``manylights`` share a start, and may have an order of samples of their own."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from vpl.core.arrays import NO_LIMIT
from vpl.core.exclusive import exclusive
from vpl.split.pixel_rays import Continued

from .camera_samples import has_free_order, may_differ
from .gathering import GatheringIntegrator


@dataclass(frozen=True)
class RenderPass:
    """A pass of a longer render; by default a render of its own.

    ``shared``: object with the ``start`` of the passes, or None; ``makes_start``: whether this pass makes the start;
    ``makes_image``; ``density``, ``half``, ``parts``, ``continued``: see :meth:`PassRenderer.pass_of`.
    """

    shared: object = None
    makes_start: bool = False
    makes_image: bool = True
    density: np.ndarray | None = None
    half: bool = False
    parts: int = 1
    continued: Continued | None = None


class PassRenderer(GatheringIntegrator):
    """Integrator that renders passes of longer renders; ``_pass``: the :class:`RenderPass` of the moment."""

    _pass = RenderPass()

    @property
    def suits_fine_film(self) -> bool:
        """Whether passes may have a finer film: not passes that Mitsuba divides, which have its order of samples."""
        return self.samples_per_pass == NO_LIMIT

    @contextmanager
    def pass_of(
        self, shared, is_first: bool, density=None, half: bool = False, parts: int = 1,
        continued: Continued | None = None,
    ):  # fmt: skip
        """Within the block, a render is a pass of a longer render and uses the start that its passes share.

        ``shared``: object with an attribute ``start``, None until the first pass is rendered; ``rays``: least number of
        camera rays for which the start is made; ``learning``: least number for which emitters are learned.  The start
        depends on the first pass and these numbers alone: where it is missing and this is not the first pass, yields
        True, and the caller has to render the first pass within :meth:`only_start`.  ``parts``: the film has ``parts``²
        pixels for each pixel of the image, the same in all passes.  ``density`` (height, width): samples of each pixel
        of the image over their mean, about; None for equal numbers.  ``half``: whether the image has the mean of every
        second sample as channels of the layer :data:`vpl.split.film_cells.HALF`, with an even number of samples for
        each pixel of the film.  Both need :meth:`may_differ`, and exclude each other.  ``continued``: earlier passes
        with this density whose lattices the samples continue, which needs :attr:`may_continue`; None for lattices of
        their own.  The density must not depend on these passes: their samples tell where the next ones lie.
        """
        if half and density is not None:
            raise ValueError("half must be False where pixels have different numbers of samples, by a density")
        with exclusive(integrator=self):
            self._pass = RenderPass(shared, is_first, density=density, half=half, parts=parts, continued=continued)
            try:
                yield shared.start is None and not is_first
            finally:
                self._pass = RenderPass()

    @contextmanager
    def only_start(self):
        """Within the block, a render makes the start of its pass and no image."""
        before = self._pass
        # The start belongs to the first pass, whose pixels have equal numbers of samples
        self._pass = replace(before, makes_start=True, makes_image=False, density=None, half=False, continued=None)
        try:
            yield
        finally:
            self._pass = before

    @property
    def may_continue(self) -> bool:
        """Whether the samples of a pass may continue the lattices of earlier passes."""
        return self.stratified and self.samples_per_pass == NO_LIMIT

    def may_differ(self, sensor, spp: int, parts: int = 1) -> bool:
        """Whether the pixels of a pass of an image for denoising may have different numbers of samples, ``spp`` in the
        mean, with ``parts``² pixels of the film for each."""
        in_one = spp <= self.samples_per_pass * parts**2
        return self.denoised and self.stratified and in_one and may_differ(sensor, spp, parts)

    def parts_of(self, sensor) -> int:
        """The ``parts`` of a pass by a ``sensor`` with its film: 1 if pixels of the film count as pixels of the image.

        Raises ValueError for a finer film with ``samples_per_pass``.
        """
        if self._pass.parts > 1 and not self.suits_fine_film:
            raise ValueError(f"parts must be 1 with samples_per_pass, got {self._pass.parts}")
        return self._pass.parts if has_free_order(sensor) else 1
