"""Names of files, trials and markers that Hydra or YAML would read as something else."""

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from support.command_line import outcome, refusal

RECORDED = "experiment=beam_real"


def shown(*arguments: str) -> Any:
    """The settings of a command line, as ``--cfg job`` prints them."""
    ended = outcome("--cfg", "job", *arguments)
    assert ended.err == ""
    return OmegaConf.to_container(OmegaConf.create(ended.out))


@pytest.fixture
def own(folder):
    """A function that writes an experiment of the user's own and returns its settings."""

    def write(text: str, *overrides: str, name: str = "own") -> Any:
        path = Path("configs/experiment", f"{name}.yaml")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"# @package _global_\n{text}", encoding="utf-8")
        return shown(f"experiment={name}", *overrides)

    return write


class TestCommandLine:
    @pytest.mark.parametrize(
        ("place", "title", "path"),
        [
            *(("20261128", "2026-11-28", "1e5"), ("010", "true", "inf"), ("on", "a (1)", "a [1]")),
            *(("[1]", "{x}", "it's"), ('q"u', "50 %", "a,b"), ("m=50g", "#1", "a:b")),
            *(("$x", "a\\b\\", "Übung é"), ("摆动", "f(x)", "choice (2)"), ("1e5", "[1]", "{x}")),
        ],
    )
    def test_texts_are_as_they_were_typed(self, folder, place, title, path):
        settings = shown(
            RECORDED,
            f"data.folder={place}",
            f"title={title}",
            "mesh=file",
            f"mesh.path={path}/a.msh",
        )
        read = settings["data"]["folder"], settings["title"], settings["mesh"]["path"]
        assert read == (place, title, f"{path}/a.msh")

    def test_what_exists_is_a_file_without_interpolation_or_sweep(self, folder):
        for name in ("${x}", "a,b", "choice(a)"):
            Path(name).mkdir()
            assert shown(RECORDED, f"data.folder={name}")["data"]["folder"] == name
        assert shown(RECORDED, "data.folder='a b'")["data"]["folder"] == "a b"
        assert shown(RECORDED, "data.folder=null")["data"]["folder"] is None
        assert shown(RECORDED, "data.folder=${name}")["data"]["folder"] == "beam_real"

    def test_names_in_lists_and_groups(self, folder):
        split = ("data.folds=null", "data.train=others", "data.test=[001,1e3,on,null, Ü 1,'a,b']")
        assert shown(RECORDED, *split)["data"]["test"] == ["001", "1e3", "on", "null", "Ü 1", "a,b"]
        trials = "data.trials={001: {file: a (1).csv}, 1e3: x=1.csv, Ü: {labels: [1, 02]}}"
        read = shown(
            RECORDED,
            "~data.trials",
            f"+{trials}",
            "data.trials.001.payload=0.1",
            "data.trials.2.file=[1]",
        )
        assert {name: trial["file"] for name, trial in read["data"]["trials"].items()} == {
            **{"001": "a (1).csv", "1e3": "x=1.csv", "Ü": None, "2": "[1]"}
        }
        assert read["data"]["trials"]["001"]["payload"] == 0.1
        assert read["data"]["trials"]["Ü"]["labels"] == ["1", "02"]
        assert [*shown(RECORDED, trials, "~data.trials.001")["data"]["trials"]][3:] == ["1e3", "Ü"]
        assert (
            refusal(RECORDED, "~data.trials.003")
            == "error: cannot remove data.trials.003: there is no such key.\n"
        )

    def test_an_empty_group_empties_it(self, folder):
        whole = [*shown()["data"]["others"]]
        assert whole
        assert shown("law=null", "data.others={}")["data"]["others"] == {}
        assert shown("law=null", "~data.others")["data"]["others"] == {}
        one = "data.others.x={twist_deg: 20}"
        assert [*shown("data.others={}", one)["data"]["others"]] == ["x"]
        assert [*shown(one)["data"]["others"]] == [*whole, "x"]

    @pytest.mark.parametrize(
        "name",
        [
            "m=50g.csv",
            "+1.csv",
            "~a.csv",
            "-1.csv",
            "Ü (1).csv",
            "on.csv",
            "a,b.csv",
            "${x}.csv",
            "#'.csv",
        ],
    )
    def test_words_are_files(self, folder, name):
        rows = "".join(f"{n / 100},{n % 7},0,0\n" for n in range(60))
        Path(name).write_text(
            f"time [s],tip.x [mm],tip.y [mm],tip.z [mm]\n{rows}", encoding="utf-8"
        )
        ended = outcome("convert", name, "to=a (1) 2026")
        assert (ended.code, ended.err) == (0, "")
        assert len([*Path("a (1) 2026").iterdir()]) == 1

    def test_the_hint_shows_the_quotes(self, folder):
        assert refusal("seed=[1").endswith(
            """and a text with special characters in quotes, 'seed="[1"'\n"""
        )
        quoted = (
            "There is no file m=60g.csv either: check its path; "
            """in quotes it is 'files=["m=60g.csv"]'.\n"""
        )
        assert refusal("inspect", "m=60g.csv").endswith(quoted)
        assert refusal("inspect", "Ü 1/m=60g.csv").startswith("error: Cannot read Ü 1/m=60g.csv: ")


class TestFiles:
    def test_names_are_texts(self, own):
        settings = own(
            """
            defaults: [beam_real, _self_]
            name: 20261128
            title: 1e3
            data:
              folder: 010
              trials:
                {001: {file: 02.csv, session: 2026-11-28, labels: [1, 02, on, null, it's]},
                  on: off, null: 3.50}
              folds: null
              train: others
              test: [001, on, null]
            markers: {tracked: {1: [0.1, 0, 0], no: [0, 0, 1.0e-2]}, register_with: [1, no]}
            """,
            name="2026",
        )
        data, markers = settings["data"], settings["markers"]
        assert (settings["name"], settings["title"], data["folder"], data["folds"]) == (
            "20261128",
            "1e3",
            "010",
            None,
        )
        assert [data["trials"][name]["file"] for name in ("001", "on", "null")] == [
            "02.csv",
            "off",
            "3.50",
        ]
        assert (data["trials"]["001"]["session"], data["test"]) == (
            "2026-11-28",
            ["001", "on", "null"],
        )
        assert data["trials"]["001"]["labels"] == ["1", "02", "on", "null", "it's"]
        assert (markers["tracked"]["1"], markers["tracked"]["no"]) == (
            [0.1, 0.0, 0.0],
            [0.0, 0.0, 0.01],
        )
        assert markers["register_with"] == ["1", "no"]

    @pytest.mark.parametrize("scheme", ["file://", ""])
    def test_they_are_in_every_folder_on_the_search_path(self, folder, scheme):
        for place, name in (("a b", "own"), ("other", "more")):
            path = folder / place / "experiment" / f"{name}.yaml"
            path.parent.mkdir(parents=True)
            path.write_text("# @package _global_\ndefaults: [beam_real, _self_]\ntitle: 010\n")
        places = f"hydra.searchpath=[{scheme}{folder}/a b,'{scheme}{folder}/other']"
        for name in ("own", "more"):
            assert shown(places, f"experiment={name}")["title"] == "010"

    def test_a_group_replaces_that_of_another_experiment(self, own):
        base = (
            "defaults: [beam_real, _self_]\nmarkers: {reference: {_replace_: true, a: [0, 0, 1], "
            "b: [0, 1, 0]}}"
        )
        assert [*own(base, name="base")["markers"]["reference"]] == ["a", "b"]
        more = own("defaults: [base]\nmarkers: {reference: {c: [1, 1, 0]}}")["markers"]["reference"]
        assert [*more] == ["a", "b", "c"]
        again = "defaults: [base, override /trainer: short, _self_]\n"
        again += "markers: {reference: {_replace_: true, c: [1, 1, 0]}}"
        assert (own(again)["trainer"]["epochs"], [*own(again)["markers"]["reference"]]) == (
            100,
            ["c"],
        )
        assert [*own(again, "markers.reference.d=[0,0,0]")["markers"]["reference"]] == ["c", "d"]
        assert (
            own("defaults: [base]\nmarkers: {reference: {_replace_: true}}")["markers"]["reference"]
            == {}
        )
