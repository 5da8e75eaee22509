"""Reader of elements of a PLY file, ascii or binary of either byte order, into columns by name.

Counts in the header are compared with the size of the file before anything is allocated.
"""

import dataclasses
import os
from pathlib import Path

import numpy as np

from ssplat_jax.core.errors import InputError
from ssplat_jax.scene_files.splat_file import read_scene_bytes

MAX_HEADER_BYTES = 1 << 16  # headers of splat files take a few kilobytes

BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}

TYPES = {
    **{name: "i1" for name in ("char", "int8")},
    **{name: "u1" for name in ("uchar", "uint8")},
    **{name: "i2" for name in ("short", "int16")},
    **{name: "u2" for name in ("ushort", "uint16")},
    **{name: "i4" for name in ("int", "int32")},
    **{name: "u4" for name in ("uint", "uint32")},
    **{name: "f4" for name in ("float", "float32")},
    **{name: "f8" for name in ("double", "float64")},
}


@dataclasses.dataclass
class Element:
    """`element` of a PLY header; with `has_list`, its rows have no fixed size."""

    name: str
    count: int
    properties: dict[str, str]  # scalar properties in order: name -> numpy type code
    has_list: bool = False

    def dtype(self, order: str) -> np.dtype:
        """Packed structured dtype of one row in byte `order`."""
        return np.dtype([(name, order + code) for name, code in self.properties.items()])


def read_vertices(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], list[str]]:
    """Reads the columns of the element `vertex`, by property name, and the comments of the header.

    Raises:
        InputError: the file cannot be read, is not a PLY file, or is shorter than its header states.
    """
    tables, comments = read_tables(path, ("vertex",))
    return tables["vertex"], comments


def read_tables(path: str | os.PathLike, names: tuple[str, ...]) -> tuple[dict[str, dict[str, np.ndarray]], list[str]]:
    """Reads the columns of elements, by element and property name, and the comments of the header.

    The first of `names` must be in the file; others that are not are left out.

    Raises:
        InputError: the file cannot be read, is not a PLY file, or is shorter than its header states.
    """
    path = Path(path)
    lines, body = _split_header(path, read_scene_bytes(path, "a PLY file"))
    file_format, elements, comments = _parse_header(path, lines)
    held, tables = {element.name for element in elements}, {}
    for name in names:
        if name in held or name == names[0]:
            before, element = _find_element(path, elements, name)
            if file_format == "ascii":
                tables[name] = _ascii_columns(path, body, before, element)
            else:
                tables[name] = _binary_columns(path, body, before, element, BYTE_ORDERS[file_format])
    return tables, comments


def _split_header(path: Path, data: bytes) -> tuple[list[str], memoryview]:
    head = data[:MAX_HEADER_BYTES]
    if not head.startswith(b"ply"):
        raise InputError(f"{path}: wanted a PLY file, it does not start with 'ply'; give a 3DGS .ply.")
    end = head.find(b"end_header")
    newline = head.find(b"\n", end)
    if end < 0 or newline < 0:
        raise InputError(
            f"{path}: header: wanted 'end_header' within {MAX_HEADER_BYTES} bytes, found none; the file is cut off "
            "or not a PLY file."
        )
    return head[:end].decode("ascii", "replace").splitlines(), memoryview(data)[newline + 1 :]


def _parse_header(path: Path, lines: list[str]) -> tuple[str, list[Element], list[str]]:
    file_format, elements, comments = "", [], []
    for line in lines[1:]:
        words = line.split()
        match words:
            case [] | ["obj_info", *_]:
                pass
            case ["comment", *rest]:
                comments.append(" ".join(rest))
            case ["format", name, "1.0"] if name in BYTE_ORDERS:
                file_format = name
            case ["element", name, count] if count.isdecimal():
                elements.append(Element(name, int(count[:20]), {}))
            case ["property", "list", *_] if elements:
                elements[-1].has_list = True
            case ["property", kind, name] if elements and kind in TYPES and name not in elements[-1].properties:
                elements[-1].properties[name] = TYPES[kind]
            case _:
                raise InputError(f"{path}: header: cannot use the line {line[:80]!r}; write the file again as PLY 1.0.")
    if not file_format:
        raise InputError(f"{path}: header: wanted a format, one of {', '.join(BYTE_ORDERS)}; there is none.")
    return file_format, elements, comments


def _find_element(path: Path, elements: list[Element], name: str) -> tuple[list[Element], Element]:
    """The elements before the one of a name, and that one."""
    names = [element.name for element in elements]
    if name not in names:
        raise InputError(
            f"{path}: wanted an element {name!r}, there is {', '.join(names) or 'none'}; give a 3DGS .ply."
        )
    position = names.index(name)
    for element in elements[: position + 1]:
        if element.has_list or not element.properties:
            came = "a list" if element.has_list else "none"
            raise InputError(
                f"{path}: element {element.name}: wanted scalar properties, it has {came}; give a 3DGS .ply."
            )
    return elements[:position], elements[position]


def _binary_columns(path: Path, body: memoryview, before: list[Element], element: Element, order: str):
    offset = sum(element.count * element.dtype(order).itemsize for element in before)
    dtype = element.dtype(order)
    _check_size(path, element, offset + element.count * dtype.itemsize, len(body), "bytes")
    rows = np.frombuffer(body, dtype, count=element.count, offset=offset) if element.count else np.zeros(0, dtype)
    return {name: rows[name] for name in element.properties}


def _ascii_columns(path: Path, body: memoryview, before: list[Element], element: Element):
    words = bytes(body).split()
    offset = sum(element.count * len(element.properties) for element in before)
    size = element.count * len(element.properties)
    _check_size(path, element, offset + size, len(words), "numbers")
    try:
        numbers = np.array(words[offset : offset + size], dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{path}: element {element.name}: wanted numbers ({error}); write the file again.") from error
    return dict(zip(element.properties, numbers.reshape(element.count, len(element.properties)).T, strict=True))


def _check_size(path: Path, element: Element, wanted: int, came: int, unit: str) -> None:
    if wanted > came:
        raise InputError(
            f"{path}: element {element.name}: wanted {wanted} {unit} for {element.count} rows, {came} are there;"
            " the file is cut off or its header wrong."
        )
