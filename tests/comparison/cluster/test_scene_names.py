"""Files that a scene names: the files that Mitsuba reads, for all XML that Mitsuba accepts."""

import pytest

from comparison.cluster import scene_names, scene_travel
from comparison.scene_files import SceneFile
from tests.comparison.cluster.test_cluster import OBJ

CAMERA = '<sensor type="perspective"/><emitter type="constant"/>'
SHAPE = '<shape type="obj"><string name="filename" value="{}"/></shape>'
SPECTRUM = '<emitter type="point"><spectrum name="intensity" {}/></emitter>'


@pytest.fixture
def folder(tmp_path):
    """A folder with files that scenes name."""
    for name in ("scene/sub", "resources"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("scene/a.obj", "scene/sub/b.obj", "resources/c.obj", "resources/d & e.obj"):
        (tmp_path / name).write_text(OBJ)
    (tmp_path / "scene/lamp.spd").write_text("400 1\n500 2\n")
    (tmp_path / "scene/secret.txt").write_text("secret")
    return tmp_path


def write(file, content, head=""):
    file.write_text(f'{head}<scene version="3.0.0">{content}</scene>')
    return file


def travelling(folder, content, head="", defines=None):
    """Return the files that travel with a scene, relative to the folder, without the scene file; Mitsuba must load
    it."""
    scene = SceneFile(write(folder / "scene/main.xml", CAMERA + content, head), defines)
    found = scene_travel.bundle(scene)
    scene.load()
    assert found.files[0].path == str(folder / "scene/main.xml")
    return {file.path.removeprefix(f"{folder}/") for file in found.files[1:]}


def test_an_inline_spectrum_is_no_name_of_a_file(folder):
    """Thirty wavelengths make an attribute longer than the 255 characters of a file name."""
    values = ", ".join(f"{400 + 10 * k}:0.{k:06}" for k in range(30))
    assert len(values) > 255
    assert travelling(folder, SPECTRUM.format(f'value="{values}"')) == set()


@pytest.mark.parametrize("length", [255, 256, 1023, 5000])
def test_a_long_name_of_a_missing_file_is_no_error(folder, length):
    scene = write(folder / "scene/main.xml", CAMERA + SHAPE.format("x" * length))
    assert list(scene_names.named_files(scene, {})) == []


@pytest.mark.parametrize(
    ("head", "value"),
    [
        ("", "../resources/d & e.obj"),
        ("", "../resources/d &amp; e.obj"),
        ("", "../resources/d &#38; e.obj"),
        ("", "../resources/d &#x26; e.obj"),
        ('<?xml version="1.0"?><!DOCTYPE scene [<!ENTITY name "value">]>', "../resources/d & e.obj"),
        ('<!-- <string name="filename" value="b --', "../resources/d & e.obj"),
    ],
)
def test_xml_is_read_as_mitsuba_reads_it(folder, head, value):
    if head.startswith("<!--"):
        head += '.obj"/> -->'
    undeclared = '<default name="undeclared" value="&nbsp; &name; &"/>'
    assert travelling(folder, undeclared + SHAPE.format(value), head) == {"resources/d & e.obj"}


def test_apostrophes_and_cdata(folder):
    hidden = "<![CDATA[" + SHAPE.format("sub/b.obj") + "]]>"
    shape = "<shape\ttype='obj'><string value = 'a.obj'\n name='filename'/></shape>"
    assert travelling(folder, hidden + shape) == {"scene/a.obj"}


@pytest.mark.parametrize(
    ("encoding", "declared"),
    [("utf-8-sig", ""), ("utf-16", ""), ("latin-1", '<?xml version="1.0" encoding="latin1"?>')],
)
def test_encodings(folder, encoding, declared):
    (folder / "scene/größe.obj").write_text(OBJ)
    text = f'{declared}<scene version="3.0.0">{SHAPE.format("größe.obj")}</scene>'
    (folder / "scene/main.xml").write_bytes(text.encode(encoding))
    assert list(scene_names.named_files(folder / "scene/main.xml", {})) == [str(folder / "scene/größe.obj")]


@pytest.mark.parametrize(
    ("defines", "included"),
    [({}, "p_a"), ({"p": "q"}, "q_a"), ({"p_a": "r"}, "r")],
)
def test_parameters_are_substituted_as_mitsuba_does(folder, defines, included):
    for name in ("p_a", "q_a", "r"):
        write(folder / f"scene/{name}.xml", "")
    declared = '<default name="p" value="p"/>' + ('<default name="p_a" value="s"/>' if "p_a" in defines else "")
    found = travelling(folder, declared + '<include filename="$p_a.xml"/>', defines=defines)
    assert found == {f"scene/{included}.xml"}


def test_parameters_of_an_included_file_are_those_of_the_rest(folder):
    write(folder / "scene/defaults.xml", '<default name="mesh" value="a"/>')
    content = '<include filename="defaults.xml"/><default name="mesh" value="sub/b"/>' + SHAPE.format("$mesh.obj")
    assert travelling(folder, content) == {"scene/defaults.xml", "scene/a.obj"}


def test_an_escaped_dollar_is_a_dollar(folder):
    (folder / "scene/$p.obj").write_text(OBJ)
    assert travelling(folder, '<default name="p" value="q"/>' + SHAPE.format("\\$p.obj")) == {"scene/$p.obj"}


def test_identifiers_and_other_attributes_are_no_files(folder):
    """Strings that no plugin opens are no files either."""
    other = '<shape type="sphere" id="secret.txt"><bsdf type="diffuse" id="/etc/hostname" name="secret.txt"/></shape>'
    other += '<default name="secret.txt" value="secret.txt"/>'
    assert travelling(folder, other) == set()
    scene = SceneFile(write(folder / "scene/main.xml", CAMERA + SHAPE.format("a.obj")))
    before = scene.fingerprint()
    noted = CAMERA + SHAPE.format("a.obj").replace("</shape>", '<string name="note" value="secret.txt"/></shape>')
    scene = SceneFile(write(folder / "scene/main.xml", noted))
    assert scene.fingerprint() != before and scene_names.named_files(scene.path, {}) == {
        str(folder / "scene/a.obj"): True
    }


def test_spectra_includes_and_meshes_travel(folder):
    write(folder / "scene/sub/part.xml", '<include filename="deep.xml"/>' + SHAPE.format("sub/b.obj"))
    write(folder / "scene/sub/deep.xml", SPECTRUM.format('filename="lamp.spd"'))
    assert travelling(folder, '<include filename="sub/part.xml"/>') == {
        "scene/sub/part.xml", "scene/sub/deep.xml", "scene/sub/b.obj", "scene/lamp.spd",
    }  # fmt: skip


def test_files_of_a_resource_folder_travel_and_count(folder):
    content = '<path value="../resources"/>' + SHAPE.format("c.obj")
    assert travelling(folder, content) == {"resources/c.obj"}
    before = SceneFile(folder / "scene/main.xml").fingerprint()
    (folder / "resources/c.obj").write_text(OBJ + "\n")
    assert SceneFile(folder / "scene/main.xml").fingerprint() != before


def test_files_by_an_absolute_path_do_not_travel(folder):
    content = f'<path value="{folder / "resources"}"/>' + SHAPE.format("c.obj") + SHAPE.format(folder / "scene/a.obj")
    travelling(folder, content)
    found = scene_names.named_files(folder / "scene/main.xml", {})
    assert found == {str(folder / "resources/c.obj"): False, str(folder / "scene/a.obj"): False}
