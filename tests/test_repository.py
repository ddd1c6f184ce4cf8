"""What stands beside the code: licence, citation, forms for issues, hooks."""

import tomllib
from pathlib import Path

import pytest

import simenv_marl

yaml = pytest.importorskip("yaml", reason="comes with the extra docs")
ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def loaded(path):
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


def test_repository_licence_is_filled_in():
    text = (ROOT / "LICENSE").read_text(encoding="utf-8")
    assert "[name of copyright owner]" not in text
    assert f"Copyright 2026 {PROJECT['authors'][0]['name']}\n" in text


def test_repository_citation_has_this_version_and_names_the_paper():
    citation = loaded("CITATION.cff")
    assert citation["version"] == simenv_marl.__version__
    assert citation["license"] == PROJECT["license"]
    assert [author["name"] for author in citation["authors"]] == [
        author["name"] for author in PROJECT["authors"]
    ]
    paper = citation["preferred-citation"]
    assert paper["title"] == "Sim-Env: Decoupling OpenAI Gym Environments from Simulation Models"
    assert [author["family-names"] for author in paper["authors"]] == [
        "Schuderer",
        "Bromuri",
        "Eekelen",
    ]
    assert paper["identifiers"][0]["value"].removeprefix("arXiv:") in paper["url"]


def test_read_the_docs_configuration_names_existing_files_and_extras():
    config = loaded(".readthedocs.yaml")
    assert (ROOT / config["sphinx"]["configuration"]).is_file()
    (install,) = config["python"]["install"]
    assert set(install["extra_requirements"]) <= PROJECT["optional-dependencies"].keys()
