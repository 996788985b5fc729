"""Reads pickles of numpy arrays, python 2's too, without running code from them: no name in the file is ever looked up.
The few names such a pickle needs stand for functions here that take bytes, check them and make an array.
"""

from __future__ import annotations

import collections
import pickle
from pathlib import Path

import numpy as np

from intabs.errors import UserError

MOST_BYTES = 1 << 31


class _Type:
    """numpy.dtype as pickle builds it: a code, then a state that holds the byte order."""

    def __init__(self, code: object = "", *_align: object):
        code = code.decode("latin1") if isinstance(code, bytes) else code
        if not isinstance(code, str) or code[:1] not in tuple("biufSU") or not code[1:].isdigit():
            raise pickle.UnpicklingError(f"arrays of type {code!r} are not read")
        self.type = np.dtype(code)

    def __setstate__(self, state: object) -> None:
        order = state[1] if isinstance(state, tuple) and len(state) > 1 else "|"
        order = order.decode("latin1") if isinstance(order, bytes) else order
        if order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"byte order {order!r}")
        self.type = self.type.newbyteorder(order)


class _Array:
    """numpy.ndarray as pickle builds it: empty, then a state (version, shape, dtype, Fortran order, bytes)."""

    value: np.ndarray | None = None

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise pickle.UnpicklingError("an array's state of an unknown form")
        shape, kind, fortran, data = state[-4:]
        if isinstance(data, str):  # python 2
            data = data.encode("latin1")
        self.value = _filled(data, kind, shape, bool(fortran))


def _filled(data: object, kind: object, shape: object, fortran: bool) -> np.ndarray:
    if not isinstance(kind, _Type) or not isinstance(data, (bytes, bytearray)) or not isinstance(shape, tuple):
        raise pickle.UnpicklingError("arrays of objects are not read")
    if not all(isinstance(n, int) and n >= 0 for n in shape):
        raise pickle.UnpicklingError(f"an array of shape {shape}")
    values = np.frombuffer(bytes(data), kind.type)
    return values.reshape(shape, order="F" if fortran else "C").astype(kind.type.newbyteorder("="))


def _reconstruct(*_subtype_shape_code: object) -> _Array:
    return _Array()


def _scalar(kind: object, data: object = b"") -> object:
    if isinstance(data, str):
        data = data.encode("latin1")
    return _filled(data, kind, (1,), False)[0].item()


def _from_buffer(data: object, kind: object, shape: object, order: object = "C") -> np.ndarray:
    return _filled(data, kind, shape if isinstance(shape, tuple) else (shape,), order == "F")


def _encode(text: object, coding: object = "latin1") -> bytes:
    if not isinstance(text, str) or coding != "latin1":
        raise pickle.UnpicklingError("text in an unknown coding")
    return text.encode("latin1")


def _no_bytes(*args: object) -> bytes:
    if args:
        raise pickle.UnpicklingError("it calls bytes()")
    return b""


_KNOWN = {
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Type,
    ("_codecs", "encode"): _encode,
    ("__builtin__", "bytes"): _no_bytes,
    ("collections", "OrderedDict"): collections.OrderedDict,
}
for _core in ("numpy.core", "numpy._core"):
    _KNOWN[f"{_core}.multiarray", "_reconstruct"] = _reconstruct
    _KNOWN[f"{_core}.multiarray", "scalar"] = _scalar
    _KNOWN[f"{_core}.numeric", "_frombuffer"] = _from_buffer


class _Unpickler(pickle._Unpickler):  # the one in Python: the one in C trusts sizes that the file states
    def find_class(self, module: str, name: str):
        try:
            return _KNOWN[module, name]
        except KeyError:
            raise pickle.UnpicklingError(f"it names {module}.{name}; only arrays are read from pickles") from None


def load(path: Path) -> object:
    """What the file holds: arrays in dictionaries, lists and tuples."""
    try:
        if path.stat().st_size > MOST_BYTES:
            raise UserError(f"{path}: larger than 2 GB")
        with open(path, "rb") as f:
            value = _Unpickler(f, encoding="latin1").load()
        return _plain(value, 0)
    except UserError:
        raise
    except pickle.UnpicklingError as e:
        raise UserError(f"{path}: refused, {e}") from None
    except RecursionError:
        raise UserError(f"{path}: refused, nested too deep") from None
    except Exception as e:  # a damaged pickle may fail anywhere
        raise UserError(f"{path}: not a pickle of arrays, or damaged ({type(e).__name__}: {e})") from None


def _plain(value: object, depth: int) -> object:
    if depth > 20:
        raise RecursionError
    if isinstance(value, _Array):
        if value.value is None:
            raise pickle.UnpicklingError("an array without contents")
        return value.value
    if isinstance(value, dict):
        return {(k if isinstance(k, str) else str(k)): _plain(v, depth + 1) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v, depth + 1) for v in value]
    return value
