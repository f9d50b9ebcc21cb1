"""References: batches and standard errors, caching and continuation, the shipped reference."""

import mitsuba as mi
import numpy as np
import pytest

from comparison import references, rendering
from comparison.scene_files import SceneFile
from tests.support.paths import CORNELL, ROOT
from tests.support.scenes import cornell


def test_batches_are_mean_and_standard_error(tmp_path):
    samples = np.random.default_rng(0).random((9, 4, 4, 3))
    batches = references.Batches()
    for image in samples[:5]:
        batches = batches.with_batch(image, 3)
    batches.write(tmp_path / "a.exr", {"integrator": "path"})
    batches = references.Batches.read(tmp_path / "a.exr")
    for image in samples[5:]:
        batches = batches.with_batch(image, 3)
    assert (batches.spp, batches.count) == (27, 9)
    np.testing.assert_allclose(batches.mean, samples.mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(batches.standard_error, samples.std(axis=0, ddof=1) / 3, rtol=1e-5)


def test_batches_of_different_sizes_count_by_their_samples():
    random, sizes = np.random.default_rng(0), (1, 3, 2, 16, 8, 1, 4)
    samples = random.normal(5, 1, (sum(sizes), 40, 50, 3))
    batches, first = references.Batches(), 0
    for size in sizes:
        batches = batches.with_batch(samples[first : first + size].mean(axis=0), size)
        first += size
    np.testing.assert_allclose(batches.mean, samples.mean(axis=0), rtol=1e-12)
    # The expected variance of the mean is the variance of a sample over the number of samples, for any batches.
    assert np.square(batches.standard_error).mean() == pytest.approx(1 / sum(sizes), rel=0.03)


def test_path_traced_references_are_kept_and_continued(tmp_path):
    first = references.path_traced(cornell(), 32, tmp_path)
    (file,) = tmp_path.glob("*.exr")
    left = [tmp_path / f".{name}.123.exr" for name in (file.stem, "other")]
    for one in left:
        one.write_text("as if killed while writing")
    again = references.path_traced(cornell(), 16, tmp_path)
    np.testing.assert_array_equal(first.image, again.image)
    more = references.path_traced(cornell(), 128, tmp_path)
    assert (first.description["spp"], more.description["spp"], first.size) == (32, 128, (16, 16))
    assert np.median(more.standard_error / first.standard_error) == pytest.approx(0.5, rel=0.3)
    at_once = references.path_traced(cornell(), 128, tmp_path / "other")
    assert np.abs(more.image - at_once.image).sum() < 0.2 * at_once.image.sum()
    assert set(tmp_path.glob("*.exr")) == {file, left[1]}  # of others, who may be writing it


def test_interrupted_reference_keeps_what_it_has(tmp_path, monkeypatch):
    render, passes = rendering.Progressive.render, []

    def interrupted(self, *arguments):
        if len(passes) == 5:
            raise KeyboardInterrupt
        passes.append(render(self, *arguments))

    monkeypatch.setattr(references.Progressive, "render", interrupted)
    with pytest.raises(KeyboardInterrupt):
        references.path_traced(cornell(), 64, tmp_path)
    monkeypatch.undo()
    (file,) = tmp_path.glob("*.exr")
    assert references.read(file).description["batches"] == 5
    assert references.path_traced(cornell(), 64, tmp_path).description["spp"] == 64


def test_kept_reference_that_cannot_be_read_is_named(tmp_path):
    references.path_traced(cornell(), 4, tmp_path)
    (file,) = tmp_path.glob("*.exr")
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(ValueError, match=f"the kept reference '{file}' cannot be read"):
        references.path_traced(cornell(), 4, tmp_path)


def altered_file(change):
    """A change of the mean, the standard error and the metadata of a reference that is kept."""

    def alter(file):
        found = references.read(file)
        described = {key: value for key, value in found.description.items() if key != "file"}
        references.write(file, *change(found.image, found.standard_error, described))

    return alter


ALTERATIONS = {
    "size": altered_file(lambda image, error, described: (image[:8], error[:8], described)),
    "not finite": altered_file(lambda image, error, described: (image * np.nan, error, described)),
    "negative error": altered_file(lambda image, error, described: (image, -error - 1, described)),
    "text for samples": altered_file(lambda image, error, described: (image, error, described | {"spp": "many"})),
    "one batch": altered_file(lambda image, error, described: (image, error, described | {"batches": 1})),
}


@pytest.mark.parametrize("alteration", ALTERATIONS)
def test_an_altered_reference_is_not_continued(tmp_path, alteration):
    references.path_traced(cornell(), 4, tmp_path)
    (file,) = tmp_path.glob("*.exr")
    ALTERATIONS[alteration](file)
    with pytest.raises(ValueError, match=f"the kept reference '{file}' cannot be read"):
        references.path_traced(cornell(), 8, tmp_path)


def test_shipped_reference_fits_the_shipped_hall():
    path = ROOT / "scenes" / "hall_reference.exr"
    reference = references.read(path)
    assert path.stat().st_size < 300_000
    assert reference.description["command"].startswith("python -m comparison.references scenes/hall.xml")
    file = SceneFile(ROOT / "scenes" / "hall.xml")
    assert reference.description["max_depth"] == file.integrator[1]["max_depth"]
    file.set_width(reference.size[0])
    assert file.size == reference.size
    image = mi.render(file.load(), spp=64).numpy()
    assert image.mean() == pytest.approx(reference.image.mean(), rel=0.03)


def test_the_command_makes_a_reference_and_checks_its_output_first(tmp_path, capsys):
    common = [CORNELL, "--width", "8", "--spp", "4", "--cache", str(tmp_path / "cache"), "--output"]
    assert references.main([*common, str(tmp_path / "none" / "a.exr")]) == 2
    assert "no folder" in capsys.readouterr().err and not list(tmp_path.iterdir())
    assert references.main([*common, str(tmp_path / "a.exr")]) == 0
    found = references.read(tmp_path / "a.exr")
    assert found.image.shape == (8, 8, 3) and found.description["spp"] >= 4


def test_values_that_are_not_finite_become_0_with_a_warning(capfd):
    image = np.ones((2, 2, 3))
    image[0, 0, 1] = np.nan
    batches = references.Batches().with_batch(image, 4)
    assert batches.mean[0, 0].tolist() == [1, 0, 1] and batches.mean[1, 1].tolist() == [1, 1, 1]
    assert "1 value(s) of a reference" in "".join(capfd.readouterr())
