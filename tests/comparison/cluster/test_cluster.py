"""Passes on workers: the image equals the image of one process bit by bit, even if workers are lost."""

import json
import os
import signal
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest

import compare
import manylights
from comparison import checkpoint, images, one_image, rendering, single_pass
from comparison.cluster import compatibility, connection, passes, pool, runs, scene_travel
from comparison.scene_files import SceneFile
from comparison.worker import Job
from tests.support.comparisons import SCHEMA, TWO_SENSORS
from tests.support.distributed_renders import TINY, in_one_process, prepared
from tests.support.paths import CORNELL
from tests.support.processes import PATIENCE, wait_until

distributed = pytest.importorskip("distributed")


USUAL = ["-D", "resx=16", "-D", "resy=16", "-i", "path", "-t", "1", "--pass-spp", "4", "--seed", "5"]


def run(*arguments):
    """Run the command in this process and return its exit status."""
    try:
        return manylights.main([str(argument) for argument in arguments])
    except SystemExit as error:
        return error.code


def pixels(file):
    return images.read_exr(file)[0]


@pytest.fixture(scope="module")
def cluster():
    """A scheduler with a worker; tests may add workers."""
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
        silence_logs=50,
    ) as started:
        yield started


def scale(cluster, count):
    cluster.scale(count)
    with distributed.Client(cluster) as client:
        client.wait_for_workers(count, timeout=PATIENCE)


@pytest.fixture
def two(cluster):
    """The address of a scheduler with two workers."""
    scale(cluster, 2)
    return cluster.scheduler_address


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """What one process renders."""
    file = tmp_path_factory.mktemp("alone") / "a.exr"
    assert run(CORNELL, *USUAL, "--spp", 42, "-o", file) == 0
    return file


# ---------------------- The image ----------------------


def test_images_do_not_depend_on_how_many_workers_there_are(cluster, alone, tmp_path):
    for count in (1, 2):
        scale(cluster, count)
        output = tmp_path / f"{count}.exr"
        assert run(CORNELL, *USUAL, "--spp", 42, "-o", output, "--workers", cluster.scheduler_address) == 0
        np.testing.assert_array_equal(pixels(output), pixels(alone))
        metadata = images.read_exr(output)[2]
        assert (metadata["spp"], metadata["passes"], metadata["ended_by"]) == (42, 11, "spp")
        made = json.loads(metadata["workers"])
        assert len(made) == count and sum(made.values()) == 11
    assert sorted(file.name for file in tmp_path.iterdir()) == ["1.exr", "2.exr"]


def test_an_error_ends_the_render_for_all_where_it_ends_one(two, tmp_path):
    common = [CORNELL, *USUAL, "--error", "0.3", "--spp", 10**6]
    assert run(*common, "-o", tmp_path / "here.exr") == 0
    assert run(*common, "-o", tmp_path / "there.exr", "--workers", two) == 0
    here, there = (images.read_exr(tmp_path / f"{name}.exr") for name in ("here", "there"))
    np.testing.assert_array_equal(here[0], there[0])
    assert there[2]["ended_by"] == "error" and there[2]["passes"] == here[2]["passes"] > 8


def test_time_ends_a_render(two, tmp_path):
    """A short time allows one pass, a longer time several."""

    def passes(seconds):
        assert run(CORNELL, *USUAL, "-o", tmp_path / "a.exr", "--workers", two, "--time", seconds) == 0
        metadata = images.read_exr(tmp_path / "a.exr")[2]
        assert metadata["ended_by"] == "time"
        return metadata["passes"]

    assert passes(1e-6) == 1
    assert any(passes(seconds) > 1 for seconds in (0.5, 5, 50))


def test_samples_of_passes_depend_on_the_image_alone():
    assert passes.samples_of_a_pass(1024**2) == 1
    assert passes.samples_of_a_pass(10**7) == 1
    assert passes.samples_of_a_pass(256**2) == 16
    assert passes.samples_of_a_pass(256**2, spp=64) == 4
    assert passes.samples_of_a_pass(256**2, spp=150) == 8
    assert passes.samples_of_a_pass(16**2, spp=1) == 4


def test_images_that_wait_for_another_one_have_bounded_memory(monkeypatch):
    """However long the first image waits for its last pass, workers begin with few of the others."""
    workers = SimpleNamespace(sources=[], workers={"one": [], "two": []})
    file = SceneFile(CORNELL, TINY)
    pixels, sampler = file.sampling(0)
    monkeypatch.setattr(passes, "WAITING_BYTES", 10 * 12 * pixels)
    waiting = [passes.DistributedPasses(workers, None, 0, 0, pixels, sampler, 4, spp=16) for _ in range(8)]
    for one in waiting:
        one.start()
    image, begun = SimpleNamespace(taken=single_pass.Pass(0, 4, 1.0)), 0
    for one in waiting[1:]:
        while task := one.next_task(0):
            one.done(task.name, image, "one")
            begun += 1
    assert begun == 10 and waiting[0].next_task(0)


# ---------------------- Faults ----------------------


def kill_a_worker(address):
    """Kill a rendering worker; the cluster replaces it after a while."""
    with distributed.Client(address) as client:
        os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)


def results_wait(address):
    """Wait until a worker holds a result."""
    with distributed.Client(address) as client:
        wait_until(lambda: any(client.run(lambda dask_worker: len(dask_worker.data)).values()))


def rendered_with_a_worker_killed(address, before=lambda address: None):
    killed = []

    def progress(took, image):
        if took.passes == 2 and not killed:
            before(address)
            killed.append(kill_a_worker(address))

    with connection.connected(address, 1) as workers:
        image, took = prepared(workers, spp=200).render(progress=progress)
    assert killed and took.spp == 200
    return image.numpy()


def test_a_worker_that_is_killed_during_a_pass_changes_nothing(two):
    np.testing.assert_array_equal(rendered_with_a_worker_killed(two), in_one_process())


def test_passes_that_a_worker_takes_with_it_are_rendered_again(two):
    """The worker is killed after it finished passes and before it hands them over."""
    np.testing.assert_array_equal(rendered_with_a_worker_killed(two, results_wait), in_one_process())


@pytest.mark.stress
@pytest.mark.parametrize("turn", range(10))
def test_a_worker_is_killed_again_and_again(two, turn):
    np.testing.assert_array_equal(rendered_with_a_worker_killed(two), in_one_process())


def test_a_task_that_ends_every_worker_is_given_up(two, monkeypatch):
    monkeypatch.setattr(passes.worker, "render_pass", signal.raise_signal)
    with connection.connected(two) as workers:
        render = prepared(workers, spp=4)
        monkeypatch.setattr(render.passes, "_bundle", signal.SIGKILL)
        monkeypatch.setattr(passes, "Task", lambda *of: pool.Task(*of[:3], (signal.SIGKILL,)))
        with pytest.raises(pool.ClusterError, match="3 workers were lost with a task"):
            render.render()


@pytest.mark.parametrize("name", compatibility.MUST_BE_EQUAL)
def test_workers_that_would_render_other_images_are_refused(name):
    own = compatibility.identity()
    refused, noted = compatibility.judge(own, own | {name: "0.0"})
    assert refused == f"{name} 0.0 instead of {own[name]}" and noted is None
    assert compatibility.judge(own, {})[0]


@pytest.mark.parametrize("name", compatibility.ARE_NOTED)
def test_workers_that_round_differently_are_noted(name):
    own = compatibility.identity()
    assert compatibility.judge(own, own | {name: "0.0"}) == (None, f"{name} 0.0 instead of {own[name]}")
    assert compatibility.judge(own, own) == (None, None)


def test_a_worker_with_another_mitsuba_gets_no_pass(two, monkeypatch, capfd, tmp_path):
    own = compatibility.identity()
    monkeypatch.setattr(pool, "identity", lambda: own | {"mitsuba": "9.9"})
    assert run(CORNELL, *USUAL, "-o", tmp_path / "a.exr", "--workers", two) == 1
    said = "".join(capfd.readouterr())
    assert f"no worker may take part: mitsuba {own['mitsuba']} instead of 9.9" in said and "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_a_scene_that_fails_to_load_is_one_line(two, tmp_path, capfd):
    scene = tmp_path / "a.xml"
    scene.write_text(
        '<scene version="3.0.0"><sensor type="perspective"/><shape type="obj"><string name="filename" '
        'value="nosuch.obj"/></shape></scene>'
    )
    assert run(scene, "--workers", two) == 1
    said = capfd.readouterr().err
    assert "nosuch.obj" in said and "tcp://127.0.0.1" in said and "Traceback" not in said


def test_a_scheduler_that_is_not_there(monkeypatch, capfd):
    monkeypatch.setattr(connection, "CONNECT_SECONDS", 0.5)
    assert run(CORNELL, "--workers", "tcp://127.0.0.1:9") == 2
    assert "no scheduler answers at tcp://127.0.0.1:9" in capfd.readouterr().err


def test_a_scheduler_that_is_not_there_is_asked_once(monkeypatch, capfd, tmp_path):
    monkeypatch.setattr(connection, "CONNECT_SECONDS", 0.5)
    assert run(CORNELL, "--frames", "1..3", "-o", tmp_path, "--workers", "tcp://127.0.0.1:9") == 2
    assert capfd.readouterr().err.count("no scheduler answers") == 1


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "localhost", "tcp://host", "1000000"])
def test_bad_workers_are_refused(text, capsys):
    assert run(CORNELL, "--workers", text) == 2
    assert f"'{text}' is neither a number of processes" in capsys.readouterr().err


def test_workers_are_let_go_where_an_image_cannot_be_denoised(two, monkeypatch):
    def broken(*_, **__):
        raise RuntimeError("no albedo")

    monkeypatch.setattr("comparison.cluster.render.Denoiser", broken)
    with connection.connected(two, 1) as workers:
        render = prepared(workers, spp=4)
        with pytest.raises(RuntimeError, match="no albedo"):
            render.render(denoise=True)
        assert not workers.sources


# ---------------------- Checkpoints ----------------------


def interrupted_after(monkeypatch, count):
    """Ctrl-C when so many passes were added."""
    keep = checkpoint.Checkpoint.keep

    def interrupt(self, seconds):
        keep(self, seconds)
        if len(self._passes.passes) == count:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(checkpoint.Checkpoint, "keep", interrupt)


@pytest.fixture
def interruptible():
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("where", ["here", "there"])
def test_a_render_that_was_interrupted_goes_on(where, two, alone, tmp_path, monkeypatch, capsys, interruptible):
    output = tmp_path / "a.exr"
    common = [CORNELL, *USUAL, "--spp", 42, "-o", output, "--resume", *(["--workers", two] * (where == "there"))]
    with monkeypatch.context() as patched:
        interrupted_after(patched, 3)
        assert run(*common) == 130
    assert "wrote 12 samples per pixel" in capsys.readouterr().err
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.checkpoint.npz", "a.exr"]
    # Another render is not mixed with it
    assert run(*common, "--seed", "6") == 1
    assert "is of a render with another seed; delete it to begin anew" in capsys.readouterr().err
    assert run(*common) == 0
    np.testing.assert_array_equal(pixels(output), pixels(alone))
    assert images.read_exr(output)[2]["passes"] == 11
    assert [file.name for file in tmp_path.iterdir()] == ["a.exr"]


def test_a_full_disk_ends_no_render(monkeypatch, tmp_path, capfd):
    def full(*_):
        raise OSError(28, "No space left on device", "a.exr")

    monkeypatch.setattr(checkpoint, "CHECKPOINT_SECONDS", 0.0)
    monkeypatch.setattr(one_image, "WRITE_SECONDS", 0.0)
    monkeypatch.setattr(checkpoint.Checkpoint, "save", full)
    monkeypatch.setattr(one_image.Output, "write", full)
    assert run(CORNELL, *USUAL, "--spp", 8, "-o", tmp_path / "a.exr", "--resume") == 1
    said = "".join(capfd.readouterr())
    assert said.count("could not be written") >= 2 and "manylights: [Errno 28] No space left on device: 'a.exr'" in said


@pytest.mark.parametrize("ends", [True, False])
def test_no_image_is_lost_by_its_checkpoint(ends, tmp_path, monkeypatch, capfd, interruptible):
    """A folder is in the place of the file: it can neither be written nor removed."""
    (tmp_path / "a.checkpoint.npz").mkdir()
    if not ends:
        interrupted_after(monkeypatch, 2)
    arguments = [CORNELL, *USUAL, "--spp", 16, "-o", tmp_path / "a.exr", "--resume"]
    assert run(*arguments) == (0 if ends else 130)
    assert images.read_exr(tmp_path / "a.exr")[2]["spp"] == (16 if ends else 8)
    said = "".join(capfd.readouterr())
    assert f"could not be {'removed' if ends else 'written'}" in said and "--resume goes on" not in said


def pass_of(value):
    planes = np.full((4, 4, 3), value, np.float32)
    return single_pass.PassImage(planes, ["R", "G", "B"], single_pass.Pass(0, 2, 1.0, {"count": np.int64(3)}))


def test_a_checkpoint_that_is_saved_while_a_pass_is_added_is_of_those_before(tmp_path, monkeypatch):
    """After Ctrl-C another thread saves the checkpoint if the main thread does not end."""
    kept, restored = rendering.Passes(0), rendering.Passes(0)
    file = checkpoint.Checkpoint(tmp_path / "a.checkpoint.npz", {})
    file.restore(kept)
    kept.add(pass_of(1.0))
    file.keep(3.0)
    monkeypatch.setattr(kept.estimate, "add", lambda *_: file.save())
    kept.add(pass_of(5.0))
    assert checkpoint.Checkpoint(file.path, {}).restore(restored) == 3.0
    assert restored.spp == 2 and (restored.image == 1.0).all() and restored.passes == kept.passes[:1]


def test_a_render_that_somebody_ends_leaves_a_checkpoint(tmp_path):
    scene, file = SceneFile(CORNELL, TINY).load(1), checkpoint.Checkpoint(tmp_path / "a.checkpoint.npz", {})
    _, took = manylights.render(scene, "path", spp=64, pass_spp=2, progress=lambda *_: False, checkpoint=file)
    assert took.ended_by == "progress" and file.path.is_file()
    assert manylights.render(scene, "path", spp=64, pass_spp=2, checkpoint=file)[1].ended_by == "spp"
    assert not file.path.exists()
    with pytest.raises(ValueError, match="checkpoint must be None where sensor is 'all'"):
        manylights.render(scene, sensor="all", checkpoint=file)


def test_a_broken_checkpoint_of_one_sensor_keeps_no_other_from_being_rendered(two, tmp_path, capsys):
    (tmp_path / "a.xml").write_text(TWO_SENSORS)
    (tmp_path / "a.sensor0.checkpoint.npz").write_bytes(b"PK\x03\x04 no more")
    assert run(tmp_path / "a.xml", "--sensor", "all", "--spp", 1, "--resume", "--workers", two) == 1
    assert f"{tmp_path / 'a.sensor0.exr'}: '{tmp_path / 'a.sensor0.checkpoint.npz'}' is no" in capsys.readouterr().err
    assert (tmp_path / "a.sensor1.exr").is_file()


def test_a_broken_checkpoint_is_named(tmp_path, capsys):
    (tmp_path / "a.checkpoint.npz").write_bytes(b"PK\x03\x04 no more")
    assert run(CORNELL, *USUAL, "--spp", 8, "-o", tmp_path / "a.exr", "--resume") == 1
    assert "is no checkpoint that can be read" in capsys.readouterr().err


# ---------------------- Scenes that travel ----------------------

OBJ = "v 0 0 9\nv 1 0 9\nv 0 1 9\nf 1 2 3\n"


def scene_with_files(folder, mesh="meshes/a.obj"):
    """A scene that includes a file, and this file names a mesh."""
    for name in ("scene", "scene/meshes", "parts"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / "scene/meshes/a.obj").write_text(OBJ)
    (folder / "parts/triangle.xml").write_text(
        f'<scene version="3.0.0"><shape type="obj"><string name="filename" value="{mesh}"/></shape></scene>'
    )
    (folder / "scene/a.xml").write_text(
        '<scene version="3.0.0"><default name="part" value="triangle"/><include filename="../parts/$part.xml"/>'
        '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/><integer name="height" '
        'value="8"/></film></sensor><emitter type="constant"/><integrator type="path"/></scene>'
    )
    return folder / "scene/a.xml"


def test_a_worker_gets_the_files_that_it_lacks(tmp_path):
    found = scene_travel.bundle(SceneFile(scene_with_files(tmp_path / "client")))
    assert [file.relative for file in found.files] == ["scene/a.xml", "parts/triangle.xml", "scene/meshes/a.obj"]
    contents = {file.hash: scene_travel.read(found, file.hash) for file in found.files}
    (tmp_path / "client").rename(tmp_path / "elsewhere")
    store = scene_travel.Store(tmp_path / "worker")
    with pytest.raises(scene_travel.FilesMissing) as missing:
        store.place(found)
    assert set(missing.value.args[0]) == set(contents)
    for hash, content in contents.items():
        store.add(hash, content)
    path = store.place(found)
    assert path.startswith(str(tmp_path / "worker")) and found.make(path).load().shapes()
    assert store.place(found) == path


def test_two_hyphens_in_a_comment_do_not_keep_a_scene_from_travelling(tmp_path):
    """The comment in the file of the hall holds the command of its generator."""
    scene = scene_with_files(tmp_path / "client")
    before = [file.relative for file in scene_travel.bundle(SceneFile(scene)).files]
    scene.write_text(f"<!-- Made by: hall.py --lights 2\n -->\n{scene.read_text()}")
    assert [file.relative for file in scene_travel.bundle(SceneFile(scene)).files] == before


def test_a_file_with_an_absolute_path_must_be_there(tmp_path):
    mesh = tmp_path / "client/scene/meshes/a.obj"
    found = scene_travel.bundle(SceneFile(scene_with_files(tmp_path / "client", mesh)))
    store = scene_travel.Store(tmp_path / "worker")
    assert store.place(found) == str(tmp_path / "client/scene/a.xml")
    mesh.write_text(OBJ + "\n")
    with pytest.raises(FileNotFoundError, match=f"'{mesh}', which the scene names by its absolute path"):
        store.place(found)


def test_a_file_that_was_changed_does_not_travel(tmp_path):
    scene = scene_with_files(tmp_path)
    found = scene_travel.bundle(SceneFile(scene))
    scene.write_text(scene.read_text() + "\n")
    with pytest.raises(ValueError, match=r"a\.xml' has been changed since the render began"):
        scene_travel.read(found, found.files[0].hash)


def test_passes_are_rendered_where_the_scene_is_not(two, tmp_path):
    scene = scene_with_files(tmp_path)
    common = [scene, "-t", "1", "-i", "path", "--spp", "8", "--pass-spp", "2"]
    assert run(*common, "-o", tmp_path / "here.exr") == 0
    with distributed.Client(two) as client:
        client.run(
            exec, "from comparison.cluster import scene_travel as travel; travel.is_there = lambda *_: False", {}
        )
        assert run(*common, "-o", tmp_path / "there.exr", "--workers", two) == 0
        folders = client.run(lambda dask_worker: dask_worker.local_directory)
    assert any(list(Path(folder).rglob("a.obj")) for folder in folders.values())
    np.testing.assert_array_equal(pixels(tmp_path / "here.exr"), pixels(tmp_path / "there.exr"))


# ---------------------- Comparisons ----------------------


def test_a_comparison_has_the_images_of_one_machine(two, tmp_path, capsys):
    command = [CORNELL, "-i", "path", "--width", "12", "--spp", "2", "--seeds", "2", "--reference", "path:16"]
    command += ["--cache", str(tmp_path / "cache"), "-t", "1"]
    assert compare.main([*command, "-o", str(tmp_path / "here")]) == 0
    assert compare.main([*command, "-o", str(tmp_path / "there"), "--workers", two]) == 0
    assert "2 workers shared the machine" in capsys.readouterr().out
    results = json.loads((tmp_path / "there/results.json").read_text())
    jsonschema.validate(results, SCHEMA, jsonschema.Draft202012Validator)
    renders = results["scenes"][0]["renders"]
    assert len(renders) == 2 and len({render["machine"]["worker"] for render in renders}) == 2
    for render in renders:
        here = tmp_path / "here" / Path(render["output"]).name
        np.testing.assert_array_equal(pixels(here), pixels(render["output"]))
    assert compare.main([*command, "--reference", "vpl", "-o", str(tmp_path / "vpl"), "--workers", two]) == 2


def test_the_same_run_by_two_labels_is_given_to_both(tmp_path):
    """Both results may be there before the first is asked for, and are written and saved by then."""

    class Workers:
        def __init__(self):
            self.sources = []

        def wait(self, seconds):
            (source,) = self.sources
            tasks = list(iter(lambda: source.next_task(0), None))
            assert tasks, "waits for ever"
            for task in tasks:
                source.done(task.name, ({"label": "?"}, {"output": b"image"}), "tcp://here")

    found, file, saved = runs.DistributedRuns(Workers()), SceneFile(CORNELL, TINY), []
    found.save = saved.append
    jobs = [Job(label, "path", CORNELL, str(tmp_path / f"{label}.exr"), run="same") for label in "ab"]
    for job in jobs:
        found.expect(job, file)
    first = found.run(jobs[0])
    assert [one["label"] for one in saved] == ["a", "b"] and first is saved[0]
    assert all((tmp_path / f"{label}.exr").read_bytes() == b"image" for label in "ab")
    assert found.run(jobs[1])["label"] == "b"


# ---------------------- Many images ----------------------


def test_frames_and_scenes_are_rendered_by_workers_as_by_one_process(two, tmp_path):
    scenes = [scene_with_files(tmp_path / name) for name in ("one", "two")]
    scenes[1] = scenes[1].rename(tmp_path / "two/scene/b.xml")
    frames = ["--frames", "9..10", "-D", "resx={frame}", "-D", "resy=8"]
    for folder, arguments in ((tmp_path / "here", []), (tmp_path / "there", ["--workers", two])):
        folder.mkdir()
        common = ["--spp", "4", "--pass-spp", "2", "-t", "1", "-i", "path", *arguments]
        assert run(CORNELL, *frames, *common, "-o", folder / "{frame:02}.exr") == 0
        assert run(*scenes, *common, "-o", folder) == 0
    files = sorted(file.name for file in (tmp_path / "here").iterdir())
    assert files == ["09.exr", "10.exr", "a.exr", "b.exr"]
    for file in files:
        np.testing.assert_array_equal(pixels(tmp_path / "here" / file), pixels(tmp_path / "there" / file))
    assert pixels(tmp_path / "there/10.exr").shape == (8, 10, 3)
