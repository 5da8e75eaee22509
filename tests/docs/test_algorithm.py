"""Names on the pages: every function and configuration field that a page names exists."""

import pkgutil
import re
import tomllib

import pytest

from ssplat_jax.config import StreamConfig
from ssplat_jax.core.errors import InputError
from ssplat_jax.network_configs import NETWORK_CONFIGS
from tests.docs.pages import INLINE_CODE, PAGES, ROOT, page_name, prose

METHOD_PAGE = ROOT / "docs" / "algorithm.md"

ENTRY_POINT_GROUPS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
"""Groups of entry points, which look like modules but are not."""

DOTTED_NAME = re.compile(r"\bssplat_jax(?:\.\w+)+")
FUNCTION_ROW = re.compile(r"\| `([\w.]+)` \| `(ssplat_jax/[\w/]+)\.py` \|")
CONFIG_FIELD = re.compile(rf"`((?:{'|'.join(StreamConfig().groups())})\.(?!py\b)\w+)")
SETTING = re.compile(r"([\w.]+)=\S+")

every_page = pytest.mark.parametrize("page", PAGES, ids=page_name)


def is_there(name: str) -> bool:
    """True if a dotted name is that of a module, class or function."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


def named_functions(text: str) -> set[str]:
    """Dotted names in the text, and those that its rows of function and file stand for."""
    rows = {f"{file.replace('/', '.')}.{name}" for name, file in FUNCTION_ROW.findall(text)}
    return rows | set(DOTTED_NAME.findall(text)) - set(ENTRY_POINT_GROUPS)


def has_field(name: str) -> bool:
    """True if the configuration of some network has a field of this full or short name."""
    for kind in NETWORK_CONFIGS:
        try:
            StreamConfig().replace(network=kind).find(name)
        except InputError:
            continue
        return True
    return False


@every_page
def test_named_functions_exist(page):
    assert not [name for name in sorted(named_functions(page.read_text())) if not is_there(name)]


@every_page
def test_named_config_fields_exist(page):
    assert not [name for name in sorted(set(CONFIG_FIELD.findall(page.read_text()))) if not has_field(name)]


def test_settings_on_algorithm_page_are_fields():
    matches = map(SETTING.fullmatch, INLINE_CODE.findall(prose(METHOD_PAGE)))
    names = {match[1] for match in matches if match}
    assert names and not [name for name in sorted(names) if not has_field(name)]
