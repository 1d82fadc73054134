"""The house: imports flow one way, importing stays light, docs say what the code says."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from partialbench import registry
from partialbench.dataset.schema import as_markdown
from partialbench.errors import InputError
from partialbench.registry import ModelCard, close_matches, load, unique

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("partialbench", "renderers", "baselines", "papnet", "leaderboard")
MAY_IMPORT = {
    "partialbench": {"partialbench"},
    "renderers": {"partialbench", "renderers"},
    "baselines": {"partialbench", "baselines"},
    "papnet": {"partialbench", "baselines", "papnet"},
    "leaderboard": {"partialbench", "leaderboard"},
}


def imported(path: Path) -> set[str]:
    """Dotted names of the modules a file imports, at any depth of its code."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return names


def forbidden(package: str, names: set[str]) -> set[str]:
    ours = {name for name in names if name.split(".")[0] in PACKAGES}
    return {name for name in ours if name.split(".")[0] not in MAY_IMPORT[package]}


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_flow_one_way(package):
    for path in (ROOT / package).rglob("*.py"):
        assert not forbidden(package, imported(path)), path
    assert forbidden("partialbench", {"renderers.hpr"}), "the check can fail"


def test_geometry_knows_neither_torch_nor_files_nor_the_rest():
    for path in (ROOT / "partialbench" / "geometry").glob("*.py"):
        for name in imported(path):
            assert not name.startswith(("torch", "h5py", "pathlib", "partialbench.dataset")), path


def test_the_rooms_of_the_benchmark_import_one_way():
    """Training may ask for a test and a test for a record, and all for the rules; never back."""
    rooms = ("protocol", "records", "testing", "training")
    hall = ROOT / "partialbench" / "benchmark"
    for number, room in enumerate(rooms):
        for path in (hall / room).glob("*.py"):
            for name in imported(path):
                later = name.removeprefix("partialbench.benchmark.").split(".")[0]
                assert later not in rooms[number + 1 :], f"{path}: {name}"


def loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(' '.join(m.split('.')[0] for m in sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    return set(run.stdout.split())


@pytest.mark.parametrize(
    "statement",
    ["import partialbench", "import partialbench.cli", "from partialbench import registry; "
     "registry.cards()", "import leaderboard.build"],
)  # fmt: skip
def test_importing_is_light(statement):
    assert not loaded_by(statement) & {"torch", "mitsuba", "open3d", "matplotlib"}


def test_the_command_line_s_help_needs_no_numbers():
    """They are a quarter of a second before a word is said."""
    assert not loaded_by("import partialbench.cli.main") & {"numpy", "scipy", "h5py", "torch"}


def test_the_light_import_check_can_fail():
    assert "torch" in loaded_by("import partialbench.benchmark.device")


@pytest.mark.parametrize(
    "entry",
    [*registry.SOURCES.values(), *registry.OCCLUDERS.values(), *registry.RELEASES.values(),
     registry.OPEN_SOURCE, registry.READ_SHAPE, registry.PICK_VARIANT, registry.MAKE_SENSOR,
     registry.LEADERBOARD,
     registry.BOARD_FILES, registry.WRITE_BOARD, registry.SHAPE_EXPORT],
)  # fmt: skip
def test_every_entry_of_the_tables_loads(entry):
    assert callable(load(entry))


def test_every_source_has_a_data_set_and_a_known_occluder():
    # One source may make several data sets: all of ModelNet40, or other meshes.
    assert set(registry.DATASET_IDS) >= set(registry.SOURCES)
    assert {occluder for _, occluder in registry.DATASET_IDS.values()} <= set(registry.OCCLUDERS)


def test_unknown_names_come_with_close_matches():
    with pytest.raises(InputError, match="no model named 'pointnt'; did you mean pointnet"):
        registry.card("pointnt")
    assert close_matches("zzz", ["b", "a"]) == "; known: a, b"
    with pytest.raises(InputError, match="no module named 'nowhere'"):
        load("nowhere:make")
    with pytest.raises(InputError, match=r"has no 'crd'; did you mean .*card"):
        load("partialbench.registry:crd")
    with pytest.raises(InputError, match="not of the form module:object"):
        load("my_model.make")


def test_a_repeated_model_name_raises():
    card = ModelCard("twin", "a:b", "Twin", "")
    with pytest.raises(ValueError, match="'twin' is registered twice: a:b and a:b"):
        unique([card, card])


def test_the_docs_show_the_schema_of_the_code():
    assert as_markdown() in (ROOT / "docs" / "data_format.md").read_text()


def test_the_page_on_own_models_shows_the_example_that_is_run():
    example = (ROOT / "examples" / "my_model.py").read_text()
    assert example in (ROOT / "docs" / "own_model.md").read_text()
    assert len(example.splitlines()) < 30


def test_links_in_the_docs_lead_somewhere():
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
            if not target.startswith(("http:", "https:")):
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_the_wheel_holds_the_five_packages_and_no_tests():
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert set(project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]) == set(PACKAGES)


def test_no_file_has_two_subjects():
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            assert len(path.read_text().splitlines()) <= 460, path
