"""Elements of a PLY file, ascii or binary of either byte order, as columns by name.

The package `plyfile` reads these too, but under the GPL, so it serves the tests alone.
"""

from typing import Any

import numpy as np

MAX_HEADER_BYTES = 1 << 16  # headers of splat files take a few kilobytes
BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
TYPES |= {"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
TYPES |= {"float32": "f4", "float64": "f8"}
Columns = dict[str, np.ndarray]
LIST = "list"  # stands for the type of a property that gives rows no fixed size


def read_tables(data: bytes) -> tuple[dict[str, Columns], list[str]]:
    """The columns of each element, by element and property name, up to the first with lists; comments of the header."""
    end = data.find(b"end_header", 0, MAX_HEADER_BYTES)
    newline = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or newline < 0:
        raise ValueError("wanted a header from 'ply' to 'end_header'")
    form, elements, comments = _parse_header(data[:end].decode("ascii", "replace").splitlines()[1:])
    is_ascii, offset = form == "ascii", 0
    body: Any = data[newline + 1 :].split() if is_ascii else memoryview(data)[newline + 1 :]
    tables: dict[str, Columns] = {}
    for name, (count, properties) in elements.items():
        if LIST in properties.values() or not properties:
            break
        row = np.dtype([(key, BYTE_ORDERS[form] + code) for key, code in properties.items()])
        size = count * (len(properties) if is_ascii else row.itemsize)
        # Compared before anything is allocated: a damaged count can be anything.
        if offset + size > len(body):
            raise ValueError(f"{count} rows of the element {name} do not fit; it is cut off")
        if is_ascii:
            numbers = np.array(body[offset : offset + size], np.float64)
            tables[name] = dict(zip(properties, numbers.reshape(count, len(properties)).T, strict=True))
        else:
            rows = np.frombuffer(body, row, count, offset) if size else np.zeros(0, row)
            tables[name] = {key: rows[key] for key in properties}
        offset += size
    return tables, comments


def _parse_header(lines: list[str]) -> tuple[str, dict[str, tuple[int, dict[str, str]]], list[str]]:
    """The format; of each element the count and the NumPy types of its properties, in order; the comments."""
    form, elements, comments, properties = "", {}, [], {}
    for line in lines:
        match line.split():
            case [] | ["obj_info", *_]:
                pass
            case ["comment", *rest]:
                comments.append(" ".join(rest))
            case ["format", name, "1.0"] if name in BYTE_ORDERS:
                form = name
            case ["element", name, count] if count.isdecimal() and name not in elements:
                elements[name] = (int(count), properties := {})
            case ["property", "list", *_] if elements:
                properties[""] = LIST
            case ["property", kind, name] if elements and kind in TYPES and name not in properties:
                properties[name] = TYPES[kind]
            case _:
                raise ValueError(f"cannot use the line {line[:80]!a} of the header")
    if not form:
        raise ValueError(f"wanted a format in the header, one of {', '.join(BYTE_ORDERS)}")
    return form, elements, comments


def stacked(table: Columns, names: list[str]) -> np.ndarray:
    """Columns of a table side by side, in float64."""
    for name in names:
        if name not in table:
            raise ValueError(f"wanted the property {name!r}, it is missing")
    return np.stack([table[name] for name in names], axis=1).astype(np.float64)
