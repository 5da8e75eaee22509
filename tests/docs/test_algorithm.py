"""Names in the documentation: every function, file and configuration field that a page names exists."""

import functools
import importlib
import re
import tomllib
from pathlib import Path

import pytest

from ssplat_jax.config import NETWORK_CONFIGS, StreamConfig
from ssplat_jax.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(path for path in (ROOT / "docs").glob("*.md") if path.name != "decisions.md")
"""All pages but the log of decisions, whose older entries name code that no longer exists."""

ENTRY_POINT_GROUPS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
"""Groups of entry points, which look like modules but are not."""

DOTTED_NAME = re.compile(r"\bssplat_jax(?:\.\w+)+")
FUNCTION_ROW = re.compile(r"\| `([\w.]+)` \| `(ssplat_jax/[\w/]+)\.py` \|")
TEST_PATH = re.compile(r"\btests/[\w/]+(?:\.py)?")
CONFIG_FIELD = re.compile(rf"`({'|'.join(StreamConfig().groups())})\.(\w+)")


def resolve(name: str) -> object:
    """The module, class or function that a dotted name refers to."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            module = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError as error:
            if not f"{name}.".startswith(f"{error.name}."):
                raise  # the module exists, but something that it imports does not
            continue
        return functools.reduce(getattr, parts[end:], module)
    raise ModuleNotFoundError(name)


def unresolved(names: set[str]) -> list[str]:
    """The names that do not resolve, sorted."""
    missing = []
    for name in sorted(names):
        try:
            resolve(name)
        except (ModuleNotFoundError, AttributeError):
            missing.append(name)
    return missing


def has_field(name: str) -> bool:
    """Whether some network's configuration has the field `name`, given as `group.field`."""
    for kind in NETWORK_CONFIGS:
        try:
            StreamConfig().replace(network=kind).find(name)
        except InputError:
            continue
        return True
    return False


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_dotted_names_resolve(page):
    assert not unresolved(set(DOTTED_NAME.findall(text_of(page))) - set(ENTRY_POINT_GROUPS))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_config_fields_exist(page):
    names = {f"{group}.{field}" for group, field in CONFIG_FIELD.findall(text_of(page))}
    assert not [name for name in sorted(names) if not has_field(name)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_functions_are_in_the_files_of_their_rows(page):
    rows = FUNCTION_ROW.findall(text_of(page))
    assert not unresolved({f"{file.replace('/', '.')}.{name}" for name, file in rows})


def test_algorithm_page_names_functions():
    text = text_of(ROOT / "docs" / "algorithm.md")
    assert len(FUNCTION_ROW.findall(text)) + len(set(DOTTED_NAME.findall(text))) >= 20


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_named_tests_exist(page):
    paths = set(TEST_PATH.findall(text_of(page)))
    assert not [path for path in sorted(paths) if not (ROOT / path).exists()]


def test_unknown_names_are_found():
    assert unresolved({"ssplat_jax.model.hpda.no_such_function"})
    assert unresolved({"ssplat_jax.no_such_module.cache_anchor"})
    assert not unresolved({"ssplat_jax.model.hpda.cache_anchor"})
    assert not has_field("memory.no_such_field")
    assert has_field("network.vit")
