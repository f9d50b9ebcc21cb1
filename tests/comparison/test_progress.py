"""Progress of a render: stages, expected end, bar of the command."""

import io
import sys
import threading
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import manylights
from comparison.ending import Ending
from comparison.progress import ImageBar
from comparison.render import Took
from integrators import PLUGINS
from tests.support.marks import stress
from tests.support.scenes import cornell
from vpl.core.stages import Stage, listening, tell

SMALL = {"vpl_count": 500, "max_depth": 3}
QUICK = ("manylights", "lightcuts", "lightslice", "illuminationcut", "adaptivedirect")


@pytest.fixture
def scene():
    return cornell().load()


def plugin(name):
    """A plugin with few virtual lights, if it has a number of lights."""
    return mi.load_dict({"type": name, **({} if name == "manylights" or "direct" in name else SMALL)})


# ---------------------- Stages ----------------------


@pytest.mark.usefixtures("lights_cost_nothing")
@pytest.mark.parametrize("name", [*QUICK, *stress(*(name for name in PLUGINS if name not in QUICK))])
def test_every_stage_that_takes_time_is_told_as_it_begins(scene, name):
    told = []
    _, took = manylights.render(
        scene, plugin(name), spp=8, pass_spp=4, progress=lambda took, image: told.append((took, image))
    )
    # Compilation happens during stages, and only without a kernel in the cache
    assert {one.stage for one, _ in told} - {None} == set(took.statistics["seconds"]) - {Stage.COMPILE}
    assert all((one.stage is None) == (image is not None) for one, image in told)
    between = [number for number, (one, _) in enumerate(told) if one.stage is None]
    assert [told[number][0].passes for number in between] == [1, 2]
    # Stages come before their pass is counted
    assert {one.passes for one, _ in told[: between[0]]} == {0}
    assert {one.passes for one, _ in told[between[0] + 1 : between[1]]} == {1}
    assert sorted(one.seconds for one, _ in told) == [one.seconds for one, _ in told]


def test_integrators_of_mitsuba_tell_of_passes_alone(scene):
    told = []
    manylights.render(scene, "path", spp=8, pass_spp=4, progress=lambda took, image: told.append(took.stage))
    assert told == [None, None]


def test_plugins_inside_of_others_tell_too(scene):
    told, moment = [], mi.load_dict({"type": "moment", "nested": {"type": "lightcuts", **SMALL}})
    manylights.render(scene, moment, spp=4, progress=lambda took, image: told.append(took.stage))
    assert "cut" in told


def test_telling_launches_no_kernels_and_changes_no_image(scene):
    def rendered(progress):
        dr.kernel_history_clear()
        image, _ = manylights.render(scene, plugin("lightcuts"), spp=8, pass_spp=4, progress=progress)
        return image.numpy(), len(dr.kernel_history())

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        rendered(None)
        expected, kernels = rendered(None)
        found, more = rendered(lambda took, image: None)
    assert kernels == more > 0
    np.testing.assert_array_equal(found, expected)


def test_false_ends_the_render_after_the_pass_that_goes_on(scene):
    _, took = manylights.render(
        scene, plugin("lightcuts"), spp=100, pass_spp=2, progress=lambda took, image: took.stage != "cut"
    )
    assert (took.ended_by, took.passes) == ("progress", 1)


@pytest.mark.parametrize(
    ("stage", "error"),
    [("gather", KeyError("mine")), ("evaluate", KeyboardInterrupt()), ("evaluate", SystemExit(3)), (None, OSError())],
)
def test_what_a_callback_raises_ends_the_render_and_nothing_is_left_behind(scene, stage, error, capfd):
    integrator = plugin("lightcuts")

    def progress(took, image):
        if took.stage == stage:
            raise error

    with pytest.raises(type(error)) as raised:
        manylights.render(scene, integrator, spp=4, progress=progress)
    assert raised.value is error
    # As an error of the render it would be told of by the integrator
    assert "LightcutsIntegrator" not in "".join(capfd.readouterr())
    again, expected = (manylights.render(scene, one, spp=4)[0].numpy() for one in (integrator, plugin("lightcuts")))
    np.testing.assert_array_equal(again, expected)


def test_errors_of_a_render_are_still_its_own(scene, monkeypatch):
    integrator = plugin("lightcuts")
    monkeypatch.setattr(type(integrator), "shade", lambda self, job: 1 / 0)
    with pytest.raises(RuntimeError, match=r"drjit\.custom"):
        manylights.render(scene, integrator, spp=4, progress=lambda took, image: None)


def test_a_listener_hears_its_own_thread_while_it_listens():
    heard, elsewhere = [], []
    tell(Stage.TREE)
    with listening(heard.append):
        tell(Stage.CUT)
        thread = threading.Thread(target=lambda: (tell(Stage.SUM), elsewhere.append(1)))
        thread.start()
        thread.join()
        with listening(lambda stage: elsewhere.append(stage)):
            tell(Stage.ROWS)
    tell(Stage.TREE)
    assert heard == [Stage.CUT] and elsewhere == [1, Stage.ROWS]


# ---------------------- The end ----------------------


def marked(ending, *marks):
    for mark in marks:
        ending.mark(*mark)
    return ending


def test_samples_to_come_cost_what_later_passes_cost():
    ending = marked(Ending(spp=100), (0, 0.0))
    assert ending.seconds_left(0.0) is None
    assert marked(ending, (4, 12.0)).seconds_left(12.0) == pytest.approx(96 * 3)
    # Without the first pass, which compiled
    assert marked(ending, (8, 14.0)).seconds_left(14.0) == pytest.approx(92 / 2)
    # Of the second half of the samples
    assert marked(ending, (24, 18.0)).seconds_left(19.0) == pytest.approx(76 * 4 / 16 - 1)
    assert marked(ending, (100, 40.0)).seconds_left(41.0) == 0


def test_the_time_given_is_what_is_left_from_the_beginning_on():
    ending = marked(Ending(time=60, after=2.0), (0, 0.0))
    assert ending.seconds_left(10.0) == 52
    # What comes first
    assert marked(Ending(spp=20, time=60), (0, 0.0), (10, 5.0)).seconds_left(5.0) == 5


def test_a_render_that_goes_on_from_a_checkpoint_counts_its_own_passes():
    ending = marked(Ending(spp=100), (40, 1000.0))
    assert ending.seconds_left(1000.0) is None
    assert marked(ending, (50, 1010.0)).seconds_left(1010.0) == pytest.approx(50)


def test_the_error_falls_as_one_over_the_root_of_the_samples():
    ending = marked(Ending(error=0.01), (0, 0.0), (4, 4.0), (8, 8.0))
    assert ending.seconds_left(8.0) is None
    ending.look(None, 8)
    assert ending.seconds_left(8.0) is None
    ending.look(0.02, 8)
    assert ending.seconds_left(8.0) == pytest.approx(32 - 8)
    # It is not looked at before there are a quarter more samples
    ending.goal.is_due(SimpleNamespace(estimate=SimpleNamespace(effective_passes=8), spp=8))
    ending.look(0.0101, 8)
    assert ending.seconds_left(8.0) == pytest.approx(2)


@pytest.mark.parametrize(("limits", "unknown"), [({"spp": 32}, 0), ({"time": 0.4}, 0), ({"error": 0.3}, 7)])
def test_the_end_is_told_and_comes_nearer(scene, limits, unknown):
    left = []
    _, took = manylights.render(
        scene, "path", pass_spp=2, progress=lambda took, image: left.append(took.seconds_left), **limits
    )  # fmt: skip
    assert left[:unknown] == [None] * unknown
    known = [seconds for seconds in left[unknown:] if seconds is not None]
    assert known[-1] < known[0] and took.seconds_left is None


# ---------------------- The bar ----------------------


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_the_bar_shows_stage_time_samples_rays_and_error(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    took = Took(16, 4, 30.0, 0.0314, {"shadow_rays": 2_500_000}, None, ["R"], stage="cuts", seconds_left=90.0)
    with ImageBar() as bar:
        bar.show(took, "4 passes")
        shown = sys.stderr.getvalue()
    assert "cuts |" in shown and "| 25%, 16 spp, 4 passes, 2.50M shadow rays, error 3.14%, 01:30 left" in shown


def test_where_nobody_watches_there_is_no_bar(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with ImageBar() as bar:
        bar.show(Took(16, 4, 30.0, None, {}, None, ["R"]))
    assert sys.stderr.getvalue() == ""
