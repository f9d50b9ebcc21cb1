"""Step of :mod:`vpl.split.path_tracer`: paths continue in new directions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .emitters.base import EmitterSampler
from .onward import Turned
from .path_state import Hit, Path, State, Vertex
from .roulette import residual_survival


def turn(path: Path, vertex: Vertex, turned: Turned, emitters: EmitterSampler):
    """Continue in the directions ``turned``, and carry the weight of gather vertices on; returns the survival
    probability by the residual.

    A path that passes a null surface, or glass that shadow rays pass, keeps the vertex and the density of its
    direction: next-event estimation passes the same surfaces.
    """
    hit, bs = vertex.hit, turned.sample
    full = path.throughput * mi.unpolarized_spectrum(turned.weight)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    # Like `path`, by the sampled direction, even if the path ends
    null = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
    path.valid |= path.active & hit.si.is_valid() & ~hit.hidden & ~null
    path.throughput, path.eta = full, path.eta * bs.eta
    direction = hit.si.to_world(bs.wo)
    survival = mi.Float(1) if path.carried is None else _turn_carried(path, vertex, turned, direction, delta)
    path.ray = hit.si.spawn_ray(dr.select(hit.hidden, path.ray.d, direction))
    turns = _turns(path, hit, bs, null, emitters)
    path.vertex, path.cell = dr.select(turns, hit.si.p, path.vertex), dr.select(turns, vertex.cell, path.cell)
    if emitters.refracts:
        path.origin = dr.select(turns, path.ray.o, path.origin)
        path.toward = dr.select(turns, path.ray.d, path.toward)
    path.emitter_samples = dr.select(turns, vertex.samples, path.emitter_samples)
    path.density, path.delta = dr.select(turns, bs.pdf, path.density), dr.select(turns, delta, path.delta)
    path.depth += dr.select(hit.goes_on, 1, 0)
    return survival


def _turns(path: Path, hit: Hit, sample: mi.BSDFSample3f, null: mi.Bool, emitters: EmitterSampler) -> mi.Bool:
    """Whether paths have a new vertex: all but those that pass a surface that shadow rays pass, too."""
    passes, traits = mi.Bool(False), emitters.traits
    if traits.null:
        # Some materials do not tell what they transmit, and block shadow rays
        passes = null & (dr.max(traits.transmission(hit.si, null & path.active)) > 0)
    if path.bent is None:
        return ~passes
    # Shadow rays pass null surfaces or glass, not both
    bends = emitters.glass.is_passed(hit.si, sample, path.active) & (path.bent | ~(path.delta | path.opened))
    passes &= ~path.bent
    turns = ~(passes | bends) if emitters.refracts else ~passes
    path.bent, path.opened = bends, passes | (path.opened & ~turns)
    return turns


def _turn_carried(path: Path, vertex: Vertex, turned: Turned, direction, delta):
    """Subtract the light that virtual lights carry from the throughput, and carry the weight of gather vertices on, in
    the world space ``direction``; returns the survival probability by the residual."""
    hit, gathers, full = vertex.hit, vertex.gathers, path.throughput
    path.cosine = hit.lobe.cosine(direction)
    # A Lambertian BSDF of value 1, times the cosine, over the density of the direction
    lambertian = ~delta & (turned.density > 0)
    lambertian = dr.select(lambertian, path.cosine / turned.density, 0)
    path.throughput = full - path.carried * lambertian
    # At diffuse surfaces the residual is the same in all directions, and has ended paths before
    judged = (dr.max(dr.abs(path.carried)) > 0) & ~hit.is_diffuse
    path.carried = vertex.weight * lambertian
    onward = dr.select(gathers & ~delta, mi.UInt32(State.CONNECTING), mi.UInt32(State.PAST))
    path.state = dr.select((path.state == State.SEEKING) & ~gathers, mi.UInt32(State.SEEKING), onward)
    # Where a BSDF is less than the minorant, the path may be all that subtracts light which virtual lights carry
    left = dr.maximum(dr.abs(path.throughput), dr.abs(path.carried))
    return residual_survival(left, full, judged)
