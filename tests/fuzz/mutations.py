"""Seeded damage to files: what a hostile or broken program may write. Mutation k of a seed is always the same."""

import json
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

NUMBERS = (
    0, -1, 1, 2, True, False, None, "", "NaN", 1.5, -0.0, 1e-300, 1e14, 1e39, 1e308, -1e9, 2**31, 2**32, 2**63, 10**400,
    math.nan, math.inf, 46_340, 6_000_000, [], {}, [[]], "x" * 100_000, "\x1b[31m\n", "../../etc/passwd", "[/b]",
)  # fmt: skip
"""What a value of JSON is replaced with."""
VALUES = (math.nan, math.inf, -math.inf, 0.0, -0.0, -1.0, 2.0, 1e-40, 1e14, -1e14, 3e38, 1e-7, 50.0, -1e4)
"""What a tensor's numbers are replaced with."""
SIZES = (0, 1, 2, 3, 4, 5, 7, 2**16, 2**31, 2**32 - 1, 2**40)
WIDTHS = {"F64": 8, "F32": 4, "F16": 2, "BF16": 2, "I64": 8, "I32": 4, "I16": 2, "U8": 1, "BOOL": 1}

Mutation = Callable[[np.random.Generator, bytes], bytes]


def choose(rng: np.random.Generator, options: Any) -> Any:
    """One of a sequence, as it is."""
    return options[int(rng.integers(len(options)))]


def mutate_json(rng: np.random.Generator, value: Any) -> Any:
    """The value with one part anywhere in it replaced, dropped, doubled, nested or renamed."""
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = choose(rng, sorted(value))
        changed = dict(value)
        how = rng.random()
        if how < 0.1:
            del changed[key]
        elif how < 0.2:
            changed[choose(rng, ("extra", "", "\x1b[2J", "k" * 10_000))] = changed.pop(key)
        else:
            changed[key] = mutate_json(rng, changed[key])
        return changed
    if isinstance(value, list) and value and rng.random() < 0.9:
        k, changed, how = int(rng.integers(len(value))), list(value), rng.random()
        if how < 0.08:
            del changed[k]
        elif how < 0.16:
            changed = [*changed, changed[k]]
        elif how < 0.2:
            changed = [changed[k]] * len(changed)
        else:
            changed[k] = mutate_json(rng, changed[k])
        return changed
    if isinstance(value, float) and rng.random() < 0.5:
        return value * choose(rng, (-1, 0, 10, 100, 1e3, 1e6, 1e12, 1e30))
    return choose(rng, NUMBERS)


def text_of(rng: np.random.Generator, value: Any) -> str:
    """JSON of the value, at times nested without end, cut, or with a number of thousands of digits."""
    text, how = json.dumps(value), rng.random()
    if how < 0.02:
        return "[" * 100_000
    if how < 0.04:
        return text[: int(rng.integers(len(text)))]
    if how < 0.06:
        return text.replace("1", "1" * 5000, 1)
    return text


def json_file(rng: np.random.Generator, data: bytes) -> bytes:
    """A JSON file with up to three parts changed."""
    value = json.loads(data)
    for _ in range(rng.integers(1, 4)):
        value = mutate_json(rng, value)
    return text_of(rng, value).encode("utf-8", "surrogatepass")


def damaged_bytes(rng: np.random.Generator, data: bytes, first: int = 400) -> bytes:
    """Bytes overwritten, inserted, repeated, cut or zeroed, most of them in front."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not changed:
            break
        reach = first if rng.random() < 0.8 else len(changed)
        place = int(rng.integers(min(len(changed), reach)))
        how = rng.integers(6)
        if how == 0:
            changed[place] = rng.integers(256)
        elif how == 1:  # a number of 4 bytes, of either order
            changed[place : place + 4] = struct.pack(choose(rng, "<>") + "I", choose(rng, SIZES) & 0xFFFFFFFF)
        elif how == 2:
            part = changed[place : place + int(rng.integers(1, 64))]
            changed[place:place] = part * int(rng.integers(1, 50))
        elif how == 3:
            del changed[place : place + int(rng.integers(1, 64))]
        elif how == 4:
            changed[place : place + 32] = bytes(len(changed[place : place + 32]))
        else:
            del changed[int(rng.integers(len(changed))) :]
    return bytes(changed)


def tensor_file(rng: np.random.Generator, data: bytes) -> bytes:
    """A safetensors file with its metadata, a tensor's numbers, shape, type or name, or its bytes changed."""
    if rng.random() < 0.1:
        return damaged_bytes(rng, data)
    size = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + size]), bytearray(data[8 + size :])
    meta = header.pop("__metadata__")
    for _ in range(rng.integers(1, 3)):
        how, name = rng.random(), choose(rng, sorted(header))
        entry = header[name]
        if how < 0.4:
            key = choose(rng, sorted(meta))
            try:
                meta[key] = text_of(rng, mutate_json(rng, json.loads(meta[key])))
            except (ValueError, RecursionError):  # what the first change left
                meta[key] = choose(rng, ("", "null", "{}", "[]"))
        elif how < 0.75:
            _change_values(rng, entry, body)
        elif how < 0.85:  # the same bytes in another shape
            count = math.prod(entry["shape"])
            entry["shape"] = choose(rng, ([count], [1, count], [count, 1], entry["shape"][::-1], [*entry["shape"], 1]))
        elif how < 0.92:
            entry["dtype"] = choose(rng, sorted(WIDTHS))
            entry["shape"] = [(entry["data_offsets"][1] - entry["data_offsets"][0]) // WIDTHS[entry["dtype"]]]
        elif how < 0.96:
            header[choose(rng, ("extra", "\x1b[31m", "n" * 5000, "gaussians.x"))] = header.pop(name)
        else:
            entry["shape"] = [choose(rng, SIZES) for _ in entry["shape"]]
    text = json.dumps({"__metadata__": {k: str(v) for k, v in meta.items()}, **header}).encode("utf-8", "replace")
    return len(text).to_bytes(8, "little") + text + bytes(body)


def _change_values(rng: np.random.Generator, entry: dict[str, Any], body: bytearray) -> None:
    """Overwrite one number, a few or all of a tensor."""
    begin, end = entry["data_offsets"]
    kinds = {"F32": "<f4", "F16": "<f2", "F64": "<f8", "I64": "<i8", "I32": "<i4"}
    if entry["dtype"] not in kinds or end <= begin:
        return
    end -= (end - begin) % WIDTHS[entry["dtype"]]  # the type may have been changed before
    values = np.frombuffer(bytes(body[begin:end]), kinds[entry["dtype"]]).copy()
    where = rng.random(len(values)) < choose(rng, (1.0, 0.01, 2 / len(values)))
    with np.errstate(over="ignore", invalid="ignore"):
        if values.dtype.kind == "i":
            values[where] = choose(rng, (-1, 0, 24_608, 12_337, 2**31, 2**62, -(2**62)))
        elif rng.random() < 0.5:
            values[where] *= choose(rng, (-1, 0, 3, 100, 1e6, 1e14))
        else:
            values[where] = choose(rng, VALUES)
    body[begin:end] = values.tobytes()
