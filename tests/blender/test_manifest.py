"""Versions of the add-on for Blender."""

import tomllib

from tests.support.paths import ROOT


def test_versions_agree():
    """Of the manifest, of the old `bl_info` and of the package."""
    folder = ROOT / "blender" / "manylights_blender"
    manifest = tomllib.loads((folder / "blender_manifest.toml").read_text())
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert manifest["version"] == version
    assert f'"version": ({version.replace(".", ", ")})' in (folder / "__init__.py").read_text()
    assert manifest["blender_version_min"] == "4.2.0" and '"blender": (4, 2, 0)' in (folder / "__init__.py").read_text()
