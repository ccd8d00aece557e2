"""Files that are nearly right: a valid one with a few random changes of bytes, words and lines, or structure."""

from __future__ import annotations

import io
import struct
import zipfile
import zlib

import numpy as np

Rng = np.random.Generator

NUMBERS = [
    "nan", "-nan", "inf", "-inf", "1e308", "-1e308", "1e-308", "-0", "0", "1", "-1", "1e999", "9" * 30, "9" * 5000,
    "0x7fffffff", "2147483648", "9223372036854775808", "1e9", "1e12", "1.5e18", "0.1", "1_000", "٣", "1e", ".", "+",
    "0b", "0x_", "._", "12:30:45", "2020-13-45", "0001-01-01", "9999-12-31", "true", "null", "~", "''", '"',
]  # fmt: skip
PIECES = [
    "", "\n", "\n\n", " ", "\t", ",", ":", "- ", "[", "]", "{", "}", "{" * 200, "[" * 2000, "&a ", "*a ", "<<: *a",
    "!!",
    "!!python/object:os.system ", "!!binary ", "!!set ", "!!timestamp 1", "? ", "| ", "%YAML 9", "---\n", "...\n", "#",
    "\x00", "\x07", "\ufeff", "\u2028", "é", "\ud7ff", "x" * 300_000, "1," * 20_000, "\\", "\r\n", "@", "`", "=", "é:",
    "../", "/dev/zero", "python:os:system", "a: &a [*a]\n", "NaN", "Infinity", '"\\ud800"', "-",
]  # fmt: skip
BOMB = "a: &a [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{b}: &{b} [{','.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
WORDS = [
    "0001-01-01 00:00:00",
    "9999-12-31 23:59:59.9",
    "2011-09-26 25:61:61",
    "now",
    "NaT",
    "2262-04-12 00:00:00",
]


def text(seed: bytes, rng: Rng) -> bytes:
    """A text file with one to four changes."""
    content = seed.decode("utf-8")
    for _ in range(rng.integers(1, 5)):
        content = _change(content, rng)
    raw = content.encode("utf-8", "surrogatepass")
    return binary(raw, rng) if rng.random() < 0.1 else raw


def _change(content: str, rng: Rng) -> str:
    lines = content.split("\n")
    at = int(rng.integers(0, len(content) + 1))
    line = int(rng.integers(0, len(lines)))
    match int(rng.integers(0, 10)):
        case 0 | 1 | 2:
            words = content.replace(",", " , ").replace("[", "[ ").replace("]", " ]").split(" ")
            words[int(rng.integers(0, len(words)))] = str(rng.choice(NUMBERS))
            return " ".join(words)
        case 3 | 4:
            return content[:at] + PIECES[int(rng.integers(0, len(PIECES)))] + content[at:]
        case 5:
            return content[:at]
        case 6:
            lines[line] = WORDS[int(rng.integers(0, len(WORDS)))] if rng.random() < 0.5 else ""
        case 7:
            other = int(rng.integers(0, len(lines)))
            lines[line], lines[other] = lines[other], lines[line]
        case 8:
            lines.insert(line, lines[int(rng.integers(0, len(lines)))])
        case 9:
            if rng.random() < 0.1:
                return BOMB + content
            del lines[line]
    return "\n".join(lines)


def binary(seed: bytes, rng: Rng) -> bytes:
    """Any file with one to eight changes of its bytes."""
    content = bytearray(seed)
    for _ in range(rng.integers(1, 9)):
        at = int(rng.integers(0, len(content) + 1))
        length = int(rng.integers(1, 64))
        match int(rng.integers(0, 7)):
            case 0 | 1:
                if at < len(content):
                    content[at] ^= 1 << int(rng.integers(0, 8))
            case 2:
                content[at : at + 4] = struct.pack(
                    "<I", int(rng.choice([0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x80000000]))
                )
            case 3:
                content[at : at + length] = b""
            case 4:
                content[at:at] = rng.bytes(length)
            case 5:
                other = int(rng.integers(0, len(content) + 1))
                content[at : at + length] = content[other : other + length]
            case 6:
                if rng.random() < 0.3:
                    del content[at:]
    return bytes(content)


def floats(seed: bytes, rng: Rng) -> bytes:
    """Rows of float32 with some of them replaced."""
    if rng.random() < 0.3:
        return binary(seed, rng)
    values = np.frombuffer(seed, "<f4").copy()
    special = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45, 0, 1e9, 100, -1], np.float32)
    count = int(rng.integers(1, len(values) if rng.random() < 0.2 else 20))
    values[rng.integers(0, len(values), count)] = rng.choice(special, count)
    return values.tobytes()


def png(seed: bytes, rng: Rng) -> bytes:
    """A PNG with changed chunks whose checksums are right."""
    if rng.random() < 0.4:
        return binary(seed, rng)
    chunks, place = [], 8
    while place < len(seed):
        length = int.from_bytes(seed[place : place + 4], "big")
        chunks.append((seed[place + 4 : place + 8], seed[place + 8 : place + 8 + length]))
        place += 12 + length
    at = int(rng.integers(0, len(chunks)))
    kind, data = chunks[at]
    match int(rng.integers(0, 7)):
        case 0 | 1:
            width, height = (
                int(rng.choice([0, 1, 7, 100_000, 0x7FFFFFFF, 0xFFFFFFFF, 300])) for _ in range(2)
            )
            rest = bytes(
                [
                    int(rng.choice([1, 2, 4, 8, 16, 3])),
                    int(rng.integers(0, 8)),
                    *rng.integers(0, 3, 3).tolist(),
                ]
            )
            chunks[0] = (
                b"IHDR",
                struct.pack(">II", width, height) + (rest if rng.random() < 0.7 else data[8:]),
            )
        case 2:
            chunks[at] = (kind, binary(data or b"x", rng))
        case 3:
            del chunks[at]
        case 4:
            chunks.insert(at, chunks[int(rng.integers(0, len(chunks)))])
        case 5:
            extra = [b"PLTE", b"tRNS", b"iCCP", b"gAMA", b"sRGB", b"acTL", b"fcTL", b"zTXt", b"eXIf", b"XXXX"]
            chunks.insert(at, (extra[int(rng.integers(0, len(extra)))], rng.bytes(int(rng.integers(0, 40)))))
        case 6:
            packed = zlib.compress(bytes(int(rng.choice([0, 10, 100_000, 5_000_000]))))
            chunks = [c for c in chunks if c[0] != b"IDAT"]
            chunks.insert(1, (b"IDAT", packed))
    parts = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )
    return seed[:8] + b"".join(parts)


def npz(seed: bytes, rng: Rng) -> bytes:
    """An archive whose members are renamed, typed, shaped, compressed, encrypted or damaged in another way."""
    if rng.random() < 0.4:
        return binary(seed, rng)
    with zipfile.ZipFile(io.BytesIO(seed)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = str(rng.choice(list(members)))
    match int(rng.integers(0, 8)):
        case 0:
            members[name] = binary(members[name], rng)
        case 1:
            shape = rng.choice(
                ["()", "(0, 3, 6)", "(100000, 100000, 6)", "(3, 6)", "(-1, 3, 6)", "(9" * 20, "(48, 9, 7)"]
            )
            head, data = members[name][:128], members[name][128:]
            start = head.index(b"'shape': ") + 9
            new = (head[10:start] + str(shape).encode() + b", }")[:117].ljust(117) + b"\n"
            members[name] = head[:10] + new + data
        case 2:
            old, new_type = (
                rng.choice(["|u1", "<U10"]),
                rng.choice(["|O", "<f8", "|V9", "<U99", ">f2", "|b1", "m8[s]"]),
            )
            members[name] = members[name].replace(str(old).encode(), str(new_type).encode(), 1)
        case 3:
            kind = [np.float16, np.float64, np.int32, np.uint8, np.bool_, np.complex64][
                int(rng.integers(0, 6))
            ]
            with np.errstate(all="ignore"):
                values = (rng.normal(size=(48, 150, 6)) * rng.choice([1, 1e300, np.nan])).astype(kind)
            members["probabilities.npy"] = _saved(values)
        case 4:
            members.pop(name)
        case 5:
            names = ["a", "\ud7ff", "road", "road"][: int(rng.integers(0, 5))]
            members["class_names.npy"] = _saved(np.array(names))
        case 6:
            members[name] += bytes(int(rng.integers(1, 10_000)))
        case 7:
            members = {f"{i}.npy": b"" for i in range(300)} | members
    out = io.BytesIO()
    how = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA][
        int(rng.integers(0, 4))
    ]
    with zipfile.ZipFile(out, "w", how) as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    content = bytearray(out.getvalue())
    if rng.random() < 0.2:  # encrypted, it says
        for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
            at = content.find(mark)
            content[at + place] |= 1
    return bytes(content)


def _saved(values: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, values, allow_pickle=False)
    return out.getvalue()


def parquet(seed: bytes, rng: Rng) -> bytes:
    """A table whose columns are dropped, renamed, of another type or of other values."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if rng.random() < 0.6:
        return binary(seed, rng)
    table = pq.read_table(pa.BufferReader(seed))
    at = int(rng.integers(0, table.num_columns))
    name, rows = table.column_names[at], table.num_rows
    match int(rng.integers(0, 6)):
        case 0:
            table = table.drop_columns([name])
        case 1:
            table = table.rename_columns([f"{n}x" if n == name else n for n in table.column_names])
        case 2:
            values = [["a"] * rows, [None] * rows, [[1.0]] * rows, [True] * rows][int(rng.integers(0, 4))]
            table = table.set_column(at, name, pa.array(values))
        case 3:
            special = rng.choice([np.nan, np.inf, 1e308, -1e308, 0.0, 1e18], rows)
            table = table.set_column(at, name, pa.array(special))
        case 4:
            table = table.slice(0, int(rng.integers(0, 3)))
        case 5:
            table = pa.table({n: pa.concat_arrays([c.combine_chunks()] * 300) for n, c in zip(table.column_names, table.columns, strict=True)})  # fmt: skip  # noqa: E501
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink)
    return bytes(sink.getvalue())
