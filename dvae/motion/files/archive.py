"""Safe reading of untrusted npz archives.

Everything in an archive is checked before it is used. Small parsers read headers (`dvae.data.npy`) and pickles as
names, shapes and bytes. If these are consistent, arrays are created from the bytes. numpy's own readers are not used,
because they evaluate headers, and fill arrays and dtypes with whatever a pickle contains.
"""

from __future__ import annotations

import io
import pickletools
import shutil
import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ...data.npy import LONGEST, NpyError, check_bytes, check_text, dtype_of, header
from ..geometry.skeleton import is_name

LARGEST = 4 * 2**30
"""Maximum size in bytes of an unpacked file."""

DENSEST, SMALL = 100, 2**26
"""Maximum compression ratio of a file that unpacks to more than `SMALL` bytes. Motion compresses to about a half."""

MAPPED = 2**28
"""Size in bytes above which an archive is written uncompressed, so that its arrays can be memory-mapped."""

INSTRUCTIONS = 2**20
"""Maximum number of instructions in a pickle; an archive has about twenty for each clip."""

_CHUNK = 2**20


@contextmanager
def archive(path: str | Path, mapping: bool = False) -> Iterator[dict[str, Member]]:
    """Open an npz file, and yield its members by name, to be read within the context.

    Args:
        path: file.
        mapping: memory-map the uncompressed float32 arrays of a large file. They use no memory, stay valid after the
            context, and are read-only.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, is not an npz, or would unpack to too many bytes. Errors raised within the
            context also name the file.
    """
    path = Path(path)
    if not path.is_file():  # excludes pipes, which might never end
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with _damage(), zipfile.ZipFile(path) as file:
            yield _members(file, path.stat().st_size, mapping)
    except MemoryError:
        raise ValueError(f"{path}: there is not enough memory to read it") from None
    except NpyError as error:
        # removes terminal control characters
        text = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in str(error))
        raise ValueError(f"{path}: {text}") from error


def holds(path: str | Path, *names: str) -> bool:
    """Return whether a file is an npz with members of these names."""
    try:
        with archive(path) as members:
            return members.keys() >= {*names}
    except (OSError, ValueError):  # the reader will report the error
        return False


@contextmanager
def _damage() -> Iterator[None]:
    """Convert the errors that the zip library raises on damaged bytes, which can be almost any, to `NpyError`."""
    try:
        yield
    except (NpyError, MemoryError, FileNotFoundError, PermissionError):
        raise
    except Exception as error:
        message = str(error)[:200] or type(error).__name__
        raise NpyError(f"damaged, truncated or not an npz archive ({message})") from error


def _limit(size: int) -> int:
    """Return the maximum unpacked size in bytes of a file of this size."""
    return min(LARGEST, max(SMALL, DENSEST * size))


def write_arrays(file: BinaryIO, arrays: Iterable[tuple[str, np.ndarray]]) -> None:
    """Write an npz that `archive` reads.

    The file is not compressed if it is large enough to be memory-mapped, or if it would compress more than `archive`
    accepts. Motion that hardly moves compresses that much.

    Args:
        file: new file, open for writing and reading.
        arrays: members by name, one at a time.
    """
    with zipfile.ZipFile(file, "w") as stored:
        for name, array in arrays:
            with stored.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)
    size = file.seek(0, io.SEEK_END)
    if size > MAPPED:
        return
    with zipfile.ZipFile(file) as stored, zipfile.ZipFile(small := io.BytesIO(), "w", zipfile.ZIP_DEFLATED) as packed:
        for info in stored.infolist():
            with stored.open(info) as source, packed.open(info.filename, "w", force_zip64=True) as member:
                shutil.copyfileobj(source, member, _CHUNK)
    if size <= _limit(small.tell()):
        file.seek(0)
        file.truncate()
        file.write(small.getbuffer())


def _members(file: zipfile.ZipFile, size: int, mapping: bool) -> dict[str, Member]:
    infos = [info for info in file.infolist() if not info.is_dir()]
    arrays: dict[str, np.ndarray] = {}
    if mapping and size > MAPPED:
        content = np.memmap(file.fp, np.uint8, "r").view(np.ndarray)  # type: ignore[call-overload]
        views = {info.filename: _view(content, info) for info in infos}
        arrays = {name: array for name, array in views.items() if array is not None}
    unpacked, limit = sum(info.file_size for info in infos if info.filename not in arrays), _limit(size)
    if unpacked > limit:
        addition = f" in addition to {len(arrays)} arrays that are mapped" if arrays else ""
        raise NpyError(
            f"it would unpack to {unpacked:,} bytes{addition}; at most {limit:,} are allowed for a file of {size:,}"
        )
    if sum(info.compress_size for info in infos) > size:
        raise NpyError("damaged: its members have more bytes than the file")
    members = {}
    for info in infos:
        name = info.filename.removesuffix(".npy")
        if info.flag_bits & 1:
            raise NpyError(f"{name} is encrypted; write the archive without a password")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            method = {9: "deflate64", 12: "bzip2", 14: "LZMA", 93: "zstd", 95: "xz"}.get(
                info.compress_type, "another method"
            )
            raise NpyError(
                f"{name} is compressed by {method}, expected deflate or none; write it with np.savez_compressed"
            )
        if not is_name(name):
            raise NpyError(f"{name[:40]!r} is not a valid name; expected at most 1000 printable characters")
        if name in members:
            raise NpyError(f"{name} occurs twice")
        members[name] = Member(name, file, info, arrays.get(info.filename))
    return members


def _view(content: np.ndarray, info: zipfile.ZipInfo) -> np.ndarray | None:
    """Return the array of a member as a view of the archive's bytes, or None if it has to be read."""
    if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1 or info.header_offset < 0:
        return None
    local = content[info.header_offset :][:30].tobytes()
    if len(local) < 30 or local[:4] != b"PK\x03\x04":
        return None
    start = info.header_offset + 30 + sum(struct.unpack("<HH", local[26:]))
    data = content[start : start + info.file_size]
    head = io.BytesIO(data[: LONGEST + 12].tobytes())
    try:
        dtype, shape, order = header(head.read)
        data = data[head.tell() :]
        check_bytes(dtype, shape, len(data))
    except NpyError:
        return None
    return data.view(dtype).reshape(shape) if dtype.str == "<f4" and order == "C" and len(data) else None


class _Stream:
    """The unpacked bytes of a member; reads beyond its end raise an error."""

    class _Raw(io.RawIOBase):
        def __init__(self, file: Any):
            self._file = file

        def readable(self) -> bool:
            return True

        def readinto(self, buffer: Any) -> int:
            data = self._file.read(min(len(buffer), _CHUNK))  # a larger request would be unpacked before it is cut
            buffer[: len(data)] = data
            return len(data)

    def __init__(self, file: Any, size: int):
        self._buffered, self.left = io.BufferedReader(self._Raw(file), 2**16), size

    def read(self, size: int) -> bytes:
        if size > self.left:
            raise EOFError(f"expected {size:,} more bytes, but only {self.left:,} are left")
        return self._count(self._buffered.read(size))

    def read_up_to(self, size: int) -> bytes:
        """Return `size` bytes, or all remaining ones."""
        return self.read(min(size, self.left))

    def readline(self) -> bytes:
        return self._count(self._buffered.readline())

    def readinto(self, array: np.ndarray) -> None:
        flat = array.reshape(-1, order="A").view(np.uint8)
        while len(flat):
            size = self._buffered.readinto(flat[:_CHUNK])  # type: ignore[arg-type]
            if not size:
                raise EOFError(f"it ends {len(flat):,} bytes early")
            flat, self.left = flat[size:], self.left - size

    def _count(self, data: bytes) -> bytes:
        self.left -= len(data)
        return data


@dataclass(frozen=True, eq=False)
class Member:
    """One npy file inside an npz.

    Args:
        name: name without the ending .npy.
    """

    name: str
    _archive: zipfile.ZipFile
    _info: zipfile.ZipInfo
    _mapped: np.ndarray | None = None

    @property
    def size(self) -> int:
        """Unpacked size in bytes."""
        return self._info.file_size

    @property
    def kind(self) -> str:
        """NumPy's kind of the elements, such as "f" for floats, "U" for text and "O" for pickled objects."""
        with self._open() as stream:
            return header(stream.read_up_to)[0].kind

    def array(self) -> np.ndarray:
        """Return the array of numbers or text.

        Raises:
            ValueError: it is damaged, or contains pickled objects.
        """
        if self._mapped is not None:
            return self._mapped
        with self._open() as stream:
            dtype, shape, order = header(stream.read_up_to)
            if dtype.hasobject:
                raise NpyError(
                    "contains pickled objects, which only a member called positions_3d may; save numbers or text"
                )
            check_bytes(dtype, shape, stream.left)
            array = np.empty(shape, dtype, order)
            stream.readinto(array)
        check_text(self.name, array)
        return array

    def clips(self) -> list[tuple[str, str, np.ndarray]]:
        """Return (split, clip, array) of a pickled dictionary of dictionaries of arrays.

        Raises:
            ValueError: it is damaged, it has other content, or its pickle contains anything but data.
        """
        with self._open() as stream:
            dtype, shape, _ = header(stream.read_up_to)
            if not dtype.hasobject or shape != ():
                raise NpyError(
                    f"has shape {shape} and dtype {dtype}, expected one pickled dictionary (shape () and dtype object)"
                )
            nested = _Interpreter(2 * stream.left + SMALL).run(stream)
            if stream.left:
                raise NpyError(f"damaged pickle: {stream.left:,} bytes follow its end")
        if isinstance(nested, _Array):  # numpy pickles the 0-dimensional array, not its item
            nested = nested.item()
        if not isinstance(nested, dict) or not all(isinstance(clips, dict) for clips in nested.values()):
            raise NpyError(f"{self.name} is not a dictionary of dictionaries (split -> clip -> positions)")
        clips_read, room = [], self._info.file_size + SMALL
        for split, clips in nested.items():
            for name, array in clips.items():
                if not isinstance(array, _Array):
                    raise NpyError(f"clip {split}/{name} is a {_type_name(array)}, expected a numpy array")
                clips_read.append((split, name, array.numbers()))
                room -= array.numbers().nbytes
                if room < 0:
                    raise NpyError(
                        f"{self.name}: its clips refer repeatedly to one array, and have more bytes than the file"
                    )
        return clips_read

    @contextmanager
    def _open(self) -> Iterator[_Stream]:
        try:
            with _damage(), self._archive.open(self._info) as file:
                yield _Stream(file, self._info.file_size)
        except NpyError as error:
            raise NpyError(f"{self.name}: {error}") from error


class _Global:
    """A function or class that a pickle names, and the safe function that is called in its place."""

    def __init__(self, name: str, call: Callable[..., Any] | None = None):
        self.name, self.call = name, call


class _Type:
    """A dtype under construction: created from its code; `build` then sets the byte order."""

    def __init__(self, dtype: np.dtype):
        self.dtype = dtype

    def build(self, state: Any) -> None:
        plain = isinstance(state, tuple) and len(state) == 8 and all(field is None for field in state[2:5])
        if not plain or state[1] not in ("<", ">", "|", "="):
            raise NpyError("refused a structured or custom dtype: expected numbers")
        if not _is_int(state[5]) or state[5] not in (-1, self.dtype.itemsize):
            raise NpyError(f"refused a dtype {self.dtype} with a wrong item size")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """An array under construction: empty at first; `build` fills it with numbers or text, or with a list of objects."""

    def __init__(self, array: np.ndarray | None = None):
        self._array = array
        self._objects: list[Any] | None = None

    def build(self, state: Any) -> None:
        if self._array is not None or not isinstance(state, tuple) or len(state) != 5:
            raise NpyError("refused an array whose pickle differs from the format of numpy")
        _, shape, kind, fortran, content = state
        if not isinstance(kind, _Type):
            raise NpyError(f"refused an array whose dtype is a {_type_name(kind)}")
        if not kind.dtype.hasobject:
            self._array = _of_bytes(content, kind.dtype, shape, "F" if fortran is True or fortran == 1 else "C")
            return
        if not isinstance(content, list) or len(content) != prod(_shape(shape)):
            raise NpyError(f"refused an array whose number of objects does not match its shape {_shape(shape)}")
        self._array, self._objects = np.empty((), object), content

    def item(self) -> Any:
        """Return the object of an array with one object; otherwise return this array."""
        return self._objects[0] if self._objects and len(self._objects) == 1 else self

    def numbers(self) -> np.ndarray:
        """Return the array of numbers or text; for objects, which are not used, return an empty array."""
        if self._array is None:
            raise NpyError("damaged pickle: an array has no content")
        return self._array


def _type_name(value: Any) -> str:
    names = {_Array: "numpy array", _Type: "dtype", _Global: "function"}
    return names.get(type(value), type(value).__name__)


def _is_int(value: Any) -> bool:
    return type(value) is int


def _shape(shape: Any) -> tuple[int, ...]:
    if not isinstance(shape, tuple) or len(shape) > 32 or not all(_is_int(n) and n >= 0 for n in shape):
        raise NpyError("refused an array with an invalid shape")
    return shape


def _bytes(content: Any) -> bytes | bytearray:
    if isinstance(content, str):  # bytes of Python 2
        return content.encode("latin1")
    if not isinstance(content, bytes | bytearray):
        raise NpyError(f"refused an array whose content has type {_type_name(content)}: expected bytes")
    return content


def _of_bytes(content: Any, dtype: np.dtype, shape: Any, order: Any) -> np.ndarray:
    content = _bytes(content)
    check_bytes(dtype, _shape(shape), len(content), "an array declares")
    if not content:
        return np.empty(shape, dtype)
    return np.frombuffer(content, dtype).reshape(shape, order=order)


class _Interpreter:
    """Interpreter of pickles: builds dict, list, tuple, str, numbers and arrays, and refuses all other types by name.

    Two bytes of a pickle can refer to an earlier value, so a short pickle can describe a huge value. Repeated values
    are therefore never copied, compared or traversed without limit.

    Args:
        room: maximum number of bytes of text and content passed to calls; repeated values count each time.
    """

    def __init__(self, room: int) -> None:
        self.room = room
        self.stack: list[Any] = []
        self.below: list[list[Any]] = []  # the stacks below the marks
        self.memo: dict[int, Any] = {}

    def run(self, stream: _Stream) -> Any:
        """Return the value of a pickle."""
        try:
            for count, (opcode, argument, _) in enumerate(pickletools.genops(stream)):  # type: ignore[arg-type]
                if count == INSTRUCTIONS:
                    raise NpyError(f"refused a pickle of more than {INSTRUCTIONS:,} instructions")
                if opcode.name in _PUSHED:
                    if type(argument) is int and argument.bit_length() > 64:
                        raise NpyError(f"refused a number of {argument.bit_length():,} bits")
                    self.stack.append(argument)
                elif opcode.name in _RULES:
                    _RULES[opcode.name](self, argument)
                else:
                    raise NpyError(f"refused the instruction {opcode.name}: {_ALLOWED}")
            return self.stack.pop()
        except (NpyError, MemoryError):
            raise
        except Exception as error:  # a damaged pickle can raise almost anything
            raise NpyError(f"damaged pickle ({type(error).__name__}: {str(error)[:200]})") from error

    def push(self, value: Any) -> None:
        self.stack.append(value)

    def mark(self, _: Any) -> None:
        self.below.append(self.stack)
        self.stack = []

    def items(self) -> list[Any]:
        """Remove and return the values above the last mark."""
        values, self.stack = self.stack, self.below.pop()
        return values

    def last(self, count: int) -> tuple[Any, ...]:
        return tuple([self.stack.pop() for _ in range(count)][::-1])

    def pop(self, _: Any) -> None:
        if self.stack:
            self.stack.pop()
        else:
            self.items()

    def put(self, place: Any) -> None:
        self.memo[len(self.memo) if place is None else place] = self.stack[-1]

    def extend(self, values: list[Any]) -> None:
        target = self.stack[-1]
        if not isinstance(target, list):
            raise NpyError(f"refused to append to a {_type_name(target)}")
        target.extend(values)

    def fill(self, items: list[Any]) -> None:
        target = self.stack[-1]
        if not isinstance(target, dict):
            raise NpyError(f"refused to set items of a {_type_name(target)}")
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str):  # only text is hashed or compared; other values could take forever
                raise NpyError(f"refused a key of type {_type_name(key)}: splits and clips have names")
            if not is_name(key):
                raise NpyError(f"refused the key {key[:40]!r}: names of splits and clips must be printable")
            target[key] = value

    def dictionary(self, _: Any) -> None:
        items = self.items()
        self.push({})
        self.fill(items)

    def find(self, name: str) -> None:
        home = name.replace("numpy._core.", "numpy.core.")  # numpy 2 renamed its core
        if home not in _GLOBALS:
            raise NpyError(f"refused {name[:200]}: {_ALLOWED}")
        self.push(_Global(home, _GLOBALS[home]))

    def find_on_stack(self, _: Any) -> None:
        module, name = self.last(2)
        if not isinstance(module, str) or not isinstance(name, str):
            raise NpyError("refused a function with an invalid name")
        self.find(f"{module}.{name}")

    def reduce(self, _: Any) -> None:
        function, arguments = self.last(2)
        if not isinstance(function, _Global) or function.call is None or not isinstance(arguments, tuple):
            raise NpyError(f"refused to call a {_type_name(function)}")
        self.spend(arguments)
        self.push(function.call(*arguments))

    def spend(self, arguments: Any) -> None:
        if isinstance(arguments, tuple) and len(arguments) <= 8:
            self.room -= sum(len(value) for value in arguments if isinstance(value, str | bytes | bytearray))
        if self.room < 0 or not isinstance(arguments, tuple) or len(arguments) > 8:
            raise NpyError("refused an array whose pickle differs from the format of numpy")

    def build(self, _: Any) -> None:
        state, target = self.stack.pop(), self.stack[-1]
        if not isinstance(target, _Array | _Type):
            raise NpyError(f"refused to set the state of a {_type_name(target)}")
        self.spend(state)
        target.build(state)


def _reconstruct(subtype: Any, shape: Any, _code: Any) -> _Array:
    if not isinstance(subtype, _Global) or subtype.name != "numpy.ndarray":
        raise NpyError(f"refused an array of the class {_type_name(subtype)}")
    if _shape(shape) != (0,):  # numpy creates every array empty and fills it afterwards
        raise NpyError(f"refused an array created with shape {shape}: numpy pickles create it with shape (0,)")
    return _Array()


def _scalar(kind: Any, content: Any) -> Any:
    if not isinstance(kind, _Type) or kind.dtype.hasobject:
        raise NpyError("refused an invalid number")
    return _of_bytes(content, kind.dtype, (), "C").item()


def _from_buffer(content: Any, kind: Any, shape: Any, order: Any, axes: Any = None) -> _Array:
    if not isinstance(kind, _Type) or kind.dtype.hasobject or order not in ("C", "F", "K"):
        raise NpyError("refused an array whose pickle differs from the format of numpy")
    array = _of_bytes(content, kind.dtype, shape, "F" if order == "F" else "C")
    if order == "K" and axes is not None:
        array = array.transpose(_shape(axes))
    return _Array(array)


def _encode(text: Any, encoding: Any) -> bytes:  # protocols 0 to 2 encode bytes in this way
    if encoding != "latin1":
        raise NpyError(f"refused the codec {str(encoding)[:40] if isinstance(encoding, str) else ''}: expected latin1")
    return bytes(_bytes(text if isinstance(text, str) else None))


_ALLOWED = (
    "a motion archive may hold only dict, list, tuple, str, numbers and numpy arrays; this one would run something "
    "else, do not trust it"
)

_GLOBALS: dict[str, Callable[..., Any] | None] = {
    "numpy.ndarray": None,
    "numpy.dtype": lambda code, align=False, copy=True: _Type(
        dtype_of(code if isinstance(code, str) else _type_name(code))
    ),
    "numpy.core.multiarray._reconstruct": _reconstruct,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _from_buffer,
    "_codecs.encode": _encode,
    **dict.fromkeys(("builtins.bytes", "__builtin__.bytes"), lambda: b""),
}

_PUSHED = {
    opcode.name
    for opcode in pickletools.opcodes
    if opcode.arg and opcode.stack_after and opcode.stack_after != [pickletools.anyobject]
}
"""Instructions that put their argument on the stack."""

_RULES: dict[str, Callable[[_Interpreter, Any], Any]] = {
    **dict.fromkeys(("PROTO", "FRAME", "STOP"), lambda self, _: None),
    "NONE": lambda self, _: self.push(None),
    "NEWTRUE": lambda self, _: self.push(True),
    "NEWFALSE": lambda self, _: self.push(False),
    "MARK": _Interpreter.mark,
    "POP": _Interpreter.pop,
    "POP_MARK": lambda self, _: self.items(),
    "DUP": lambda self, _: self.push(self.stack[-1]),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _Interpreter.put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), lambda self, place: self.push(self.memo[place])),
    "EMPTY_LIST": lambda self, _: self.push([]),
    "EMPTY_DICT": lambda self, _: self.push({}),
    "EMPTY_TUPLE": lambda self, _: self.push(()),
    "LIST": lambda self, _: self.push(self.items()),
    "TUPLE": lambda self, _: self.push(tuple(self.items())),
    "TUPLE1": lambda self, _: self.push(self.last(1)),
    "TUPLE2": lambda self, _: self.push(self.last(2)),
    "TUPLE3": lambda self, _: self.push(self.last(3)),
    "DICT": _Interpreter.dictionary,
    "APPEND": lambda self, _: self.extend(list(self.last(1))),
    "APPENDS": lambda self, _: self.extend(self.items()),
    "SETITEM": lambda self, _: self.fill(list(self.last(2))),
    "SETITEMS": lambda self, _: self.fill(self.items()),
    "GLOBAL": lambda self, name: self.find(".".join(name.split(" ", 1))),
    "STACK_GLOBAL": _Interpreter.find_on_stack,
    "REDUCE": _Interpreter.reduce,
    "BUILD": _Interpreter.build,
}
