"""Checkpoints that are damaged or altered: each is refused by one message with the name of the file."""

import json

import numpy as np
import pytest

import manylights
from comparison.checkpoint import Checkpoint
from comparison.rendering import Passes
from tests.comparison.cluster.test_cluster import pass_of
from tests.support.paths import CORNELL


@pytest.fixture
def file(tmp_path):
    """A checkpoint of two passes."""
    passes, checkpoint = Passes(0), Checkpoint(tmp_path / "a.checkpoint.npz", {})
    passes.keeps_halves = True
    checkpoint.restore(passes)
    for value in (1.0, 3.0):
        passes.add(pass_of(value))
    checkpoint.keep(3.0)
    checkpoint.save()
    return checkpoint.path


def altered(file, change):
    """Replace arrays of a checkpoint; `change` gets them as a dict."""
    with np.load(file) as opened:
        arrays = {name: opened[name] for name in opened.files}
    change(arrays)
    np.savez(file, **arrays)


def half_the_samples(arrays):
    described = json.loads(arrays["described"].item())
    for one in described["passes"]:
        one["spp"] = 1
    arrays["described"] = np.array(json.dumps(described))


ALTERATIONS = {
    "another shape": lambda arrays: arrays.update(sum=arrays["sum"][:2]),
    "another type": lambda arrays: arrays.update(sum=arrays["sum"].astype(np.float32)),
    "not a number": lambda arrays: arrays.update(sum=arrays["sum"] * np.nan),
    "a brighter sum": lambda arrays: arrays.update(sum=arrays["sum"] * 2),
    "fewer samples": half_the_samples,
    "another weight": lambda arrays: arrays.update({"estimate._weight": np.array(1)}),
    "other halves": lambda arrays: arrays.update(first_sum=arrays["sum"]),
    "no sum": lambda arrays: arrays.pop("sum"),
    "no description": lambda arrays: arrays.pop("described"),
    "no digest": lambda arrays: arrays.pop("digest"),
    "one array more": lambda arrays: arrays.update({"estimate._more": np.zeros(3)}),
    "a description of objects": lambda arrays: arrays.update(described=np.array([{}])),
    "a list for a description": lambda arrays: arrays.update(described=np.array("[]")),
}


@pytest.mark.parametrize("is_told_before", [True, False])
@pytest.mark.parametrize("denoises", [True, False])
def test_halves_continue_if_the_render_denoises(file, denoises, is_told_before):
    """Renders on workers restore a checkpoint before they have a denoiser."""
    passes = Passes(0)
    if is_told_before:
        passes.keeps_halves = denoises
    Checkpoint(file, {}).restore(passes)
    passes.keeps_halves = denoises
    assert passes.has_halves is denoises and passes.image.mean() == 2
    if denoises:
        assert [half.mean() for half in passes.fine_halves] == [1, 3]
        passes.add(pass_of(8.0))
        assert [half.mean() for half in passes.fine_halves] == [4.5, 3]


@pytest.mark.parametrize("is_told_before", [True, False])
def test_a_checkpoint_without_halves_has_none(tmp_path, is_told_before):
    kept, restored = Passes(0), Passes(0)
    checkpoint = Checkpoint(tmp_path / "a.checkpoint.npz", {})
    checkpoint.restore(kept)
    kept.add(pass_of(1.0))
    checkpoint.keep(1.0)
    checkpoint.save()
    restored.keeps_halves = is_told_before
    Checkpoint(checkpoint.path, {}).restore(restored)
    restored.keeps_halves = True
    assert not restored.has_halves and restored.image.mean() == 1
    restored.add(pass_of(3.0))
    assert not restored.has_halves and restored.image.mean() == 2


@pytest.mark.parametrize("alteration", ALTERATIONS)
def test_an_altered_checkpoint_is_refused_by_name(alteration, file):
    altered(file, ALTERATIONS[alteration])
    passes = Passes(0)
    with pytest.raises(ValueError, match=f"'{file}' is no checkpoint that can be read") as error:
        Checkpoint(file, {}).restore(passes)
    assert "delete it to begin anew" in str(error.value) and passes.passes == []


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no more", b"text", b"cut", b"array"])
def test_a_damaged_checkpoint_is_refused_by_name(content, file):
    if content == b"cut":
        content = file.read_bytes()[:-200]
    if content == b"array":
        with file.open("wb") as opened:
            np.save(opened, np.zeros(3))
    else:
        file.write_bytes(content)
    with pytest.raises(ValueError, match=f"'{file}' is no checkpoint that can be read"):
        Checkpoint(file, {}).restore(Passes(0))


def test_every_damaged_byte_is_found_or_harmless(file):
    whole, passes = file.read_bytes(), Passes(0)
    assert Checkpoint(file, {}).restore(passes) == 3.0
    for position in range(0, len(whole), 7):
        file.write_bytes(whole[:position] + bytes([whole[position] ^ 0x55]) + whole[position + 1 :])
        found = Passes(0)
        try:
            Checkpoint(file, {}).restore(found)
        except ValueError as error:
            assert str(file) in str(error)
        else:
            assert (found.image == passes.image).all() and found.passes == passes.passes


def test_the_command_names_an_altered_checkpoint(tmp_path, capsys):
    file = tmp_path / "a.checkpoint.npz"
    np.savez(file, described=np.array("{}"))
    arguments = [CORNELL, "-D", "resx=8", "-D", "resy=8", "-i", "path", "--spp", "1", "--resume"]
    assert manylights.main([*arguments, "-o", str(tmp_path / "a.exr")]) == 1
    said = capsys.readouterr().err
    assert (
        said == f"manylights: '{file}' is no checkpoint that can be read (it has no entry 'digest'); delete it to "
        "begin anew\n"
    )
