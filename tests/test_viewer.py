"""The viewer's server: right numbers, and nothing for those who should have none."""

import http.client
import json
import socket
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import spectral
import websockets
import xarray as xr
from typer.testing import CliRunner
from websockets.frames import Frame, Opcode

from serving import Line, running
from squilla.cli.app import app
from squilla.colour import linear_rgb
from squilla.errors import InputError
from squilla.evaluation.metrics import sam
from squilla.files.cube import labelled, save
from squilla.live import protocol, server
from squilla.live.protocol import Picture, Spectra
from squilla.live.reference import parse_references, read_references
from squilla.live.stored import StoredCube
from squilla.spectra import grid


@pytest.fixture(scope="module")
def cube() -> xr.DataArray:
    """30 x 40 px, 51 bands, one pixel without numbers."""
    random = np.random.default_rng(4)
    values = random.random((30, 40, 51), dtype=np.float32)
    values[3, 5] = np.nan
    return labelled(values, grid(step=5))


@pytest.fixture(scope="module")
def maps(cube) -> dict[str, xr.DataArray]:
    return {
        "uncertainty": (cube / 10).rename("uncertainty"),
        "valid": (cube.isel(wavelength=0, drop=True) > 0.5).rename("valid"),
    }


@pytest.fixture(scope="module")
def file(cube, maps, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("cubes") / "doll.nc"
    save(cube, path, extra=maps)
    return path


@pytest.fixture(scope="module")
def address(file) -> Iterator[str]:
    with running(StoredCube.open(file)) as place:
        yield place


@pytest.fixture
def page(address) -> Iterator[Line]:
    page = Line(address)
    yield page
    page.socket.close()


def get(address: str, path: str, **headers: str) -> http.client.HTTPResponse:
    """Ask for a path exactly as it is written, with a Host of one's own if wanted."""
    line = http.client.HTTPConnection(address, timeout=10)
    line.putrequest("GET", path, skip_host="host" in headers)
    for name, value in headers.items():
        line.putheader(name, value)
    line.endheaders()
    return line.getresponse()


def let_in(address: str, **headers: str) -> bool:
    """Knock at the WebSocket and tell whether it opens."""
    knock = {
        "connection": "Upgrade", "upgrade": "websocket", "sec-websocket-version": "13",
        "sec-websocket-key": "c3F1aWxsYXNxdWlsbGEwMQ==",
    }  # fmt: skip
    answer = get(address, "/socket", **knock, **headers)
    answer.close()
    return answer.status == 101


# --- the numbers --------------------------------------------------------------------------------


def test_hello_tells_what_there_is(page, cube):
    (source,) = page.hello["sources"]
    assert (source["rows"], source["columns"], source["title"]) == (30, 40, "doll.nc")
    np.testing.assert_array_equal(source["wavelength"], cube.wavelength)
    assert {each["name"]: each["spectral"] for each in source["layers"]} == {
        "uncertainty": True,
        "valid": False,
    }
    assert source["colours"][0] != source["colours"][20]


def test_bands_and_layers_are_those_of_the_file(page, cube, maps):
    header, band = page.ask(ask="picture", kind="band", band=17)
    np.testing.assert_array_equal(band[0], cube.values[..., 17])
    assert (header["id"], header["stride"]) == (7, 1)
    _, part = page.ask(ask="picture", kind="band", band=17, window=[4, 6, 20, 30])
    np.testing.assert_array_equal(part[0], cube.values[4:20, 6:30, 17])
    _, valid = page.ask(ask="picture", kind="layer", layer="valid")
    np.testing.assert_array_equal(valid[0], maps["valid"])
    _, error = page.ask(ask="picture", kind="layer", layer="uncertainty", band=3)
    np.testing.assert_array_equal(error[0], maps["uncertainty"].values[..., 3])


def test_spectra_are_those_of_the_file(page, cube):
    regions = [[2, 3, 3, 4], [0, 0, 10, 20], [0, 0, 30, 40]]
    header, (mean, spread) = page.ask(ask="spectra", regions=regions)
    np.testing.assert_array_equal(mean[0], cube.values[2, 3])
    np.testing.assert_array_equal(spread[0], 0)
    for row, (top, left, bottom, right) in enumerate(regions[1:], 1):
        part = cube.values[top:bottom, left:right].reshape(-1, 51).astype(float)
        np.testing.assert_allclose(mean[row], np.nanmean(part, 0), rtol=1e-6)
        np.testing.assert_allclose(spread[row], np.nanstd(part, 0), rtol=1e-6)
    assert header["pixels"] == [1, 200, 1200]
    _, (lost, _) = page.ask(ask="spectra", regions=[[3, 5, 4, 6]])
    assert np.isnan(lost).all()
    _, (error, _) = page.ask(ask="spectra", regions=[[2, 3, 3, 4]], layer="uncertainty")
    np.testing.assert_array_equal(error[0], (cube / 10).values[2, 3])


def test_maps_agree_with_the_rest_of_the_house(page, cube):
    target = cube.values[8, 9]
    _, angle = page.ask(ask="picture", kind="angle", spectrum=target.tolist())
    np.testing.assert_allclose(angle[0], sam(cube.values, target), atol=1e-6)
    assert angle[0, 8, 9] < 1e-6
    seen = np.isfinite(cube.values).all(-1)
    white = (0.5 + cube.values[1, 1]).tolist()
    for more in ({}, {"white": white}):
        _, colour = page.ask(ask="picture", kind="colour", **more)
        expected = linear_rgb(cube.values, cube.wavelength.values, white=more.get("white"))
        np.testing.assert_allclose(np.moveaxis(colour, 0, -1)[seen], expected[seen], atol=1e-5)
    assert not np.isfinite(colour[:, ~seen]).any()


@pytest.mark.parametrize("suffix", [".nc", ".hdr", ".zarr", ".tiff"])
def test_by_need_gives_the_same(cube, maps, tmp_path, suffix, monkeypatch):
    """A cube that may not be held is read piece by piece, in one stride and another."""
    monkeypatch.setattr("squilla.live.stored._BLOCK", 4 * 51 * 40 * 7)
    path = tmp_path / f"doll{suffix}"
    save(cube, path, extra=maps)
    for longest in (1024, 16):
        monkeypatch.setattr("squilla.live.answer.LARGEST_SIDE", longest)
        held, by_need = StoredCube.open(path), StoredCube.open(path, held=0)
        assert by_need.describe()["by_need"]
        assert not held.describe()["by_need"]
        asks = [
            Picture(kind="band", band=30),
            Picture(kind="band", band=31, window=(3, 1, 29, 38)),
            Picture(kind="colour"),
            Picture(kind="angle", spectrum=cube.values[8, 9].tolist()),
            Picture(kind="layer", layer="uncertainty", band=2),
        ]
        for ask in asks:
            (one, told), (other, same) = held.picture(ask), by_need.picture(ask)
            np.testing.assert_allclose(other, one, rtol=1e-5, atol=1e-6)
            assert told == same
            assert max(one.shape[1:]) <= longest
        ask = Spectra(regions=[(2, 3, 3, 4), (1, 1, 29, 39)])
        np.testing.assert_allclose(by_need.spectra(ask)[0], held.spectra(ask)[0], rtol=1e-6)


def test_large_cubes_never_come_whole(tmp_path):
    """A picture and a spectrum of a cube on disk cost memory for themselves alone."""
    import tracemalloc

    lines, samples, bands = 600, 500, 200  # 240 MB, sparse on disk
    path = tmp_path / "vast.hdr"
    wavelength = np.linspace(400, 1000, bands)
    header = {
        "samples": samples, "lines": lines, "bands": bands, "header offset": 0, "data type": 4,
        "interleave": "bsq", "byte order": 0, "wavelength": wavelength.tolist(),
        "wavelength units": "nm",
    }  # fmt: skip
    spectral.envi.write_envi_header(str(path), header)
    with path.with_suffix(".img").open("wb") as stream:
        stream.truncate(4 * lines * samples * bands)
    source = StoredCube.open(path, held=0)
    tracemalloc.start()
    picture, _ = source.picture(Picture(kind="band", band=100))
    source.spectra(Spectra(regions=[(5, 5, 6, 6)]))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert picture.shape == (1, lines, samples)
    assert peak < 12 * picture.nbytes


# --- bad messages -------------------------------------------------------------------------------

WRONG = {
    "no JSON": "{",
    "no object": "[1]",
    "unknown": '{"ask": "files"}',
    "path": '{"ask": "picture", "kind": "layer", "layer": "../../etc/passwd"}',
    "extra": '{"ask": "picture", "kind": "band", "path": "/etc/passwd"}',
    "band": '{"ask": "picture", "kind": "band", "band": 51}',
    "negative": '{"ask": "picture", "kind": "band", "band": -1}',
    "source": '{"ask": "picture", "source": 3, "kind": "band"}',
    "outside": '{"ask": "spectra", "regions": [[0, 0, 31, 1]]}',
    "empty": '{"ask": "spectra", "regions": [[5, 5, 5, 6]]}',
    "many": json.dumps({"ask": "spectra", "regions": [[0, 0, 1, 1]] * 33}),
    "short": '{"ask": "picture", "kind": "angle", "spectrum": [1, 2]}',
    "NaN": '{"ask": "picture", "kind": "angle", "spectrum": [NaN]}',
    "none": '{"ask": "picture", "kind": "angle"}',
    "table": '{"ask": "reference", "name": "x", "text": "not a table"}',
    "live": '{"ask": "control", "name": "exposure", "value": 3}',
    "watch": '{"ask": "watch", "wanted": []}',
}


def test_bad_messages_are_answered_in_words_and_do_no_harm(page, cube):
    for name, text in WRONG.items():
        if name == "watch":
            text = text.replace("[]", '[{"kind": "band"}]')
        header, values = page.tell(text)
        assert values is None, name
        assert header["error"], name
    assert "error" in page.tell(b"\x00\x01")[0]
    _, band = page.ask(ask="picture", kind="band", band=0)
    np.testing.assert_array_equal(band[0], cube.values[..., 0])


def test_a_file_that_vanishes_is_said_on_the_page(cube, tmp_path):
    path = tmp_path / "gone.zarr"
    save(cube, path)
    source = StoredCube.open(path, held=0)
    for chunk in (path / "radiance" / "c").rglob("*"):
        if chunk.is_file():
            chunk.write_bytes(b"rot")
    with running(source) as address:
        page = Line(address)
        header, _ = page.ask(ask="picture", kind="band", band=0)
        assert "could not be read" in header["error"]
        header, _ = page.ask(ask="picture", kind="band", band=99)
        assert "51 bands" in header["error"]
        page.socket.close()


# --- who is let in ------------------------------------------------------------------------------


def test_only_pages_of_its_own_origin(address):
    port = address.rpartition(":")[2]
    assert let_in(address, origin=f"http://{address}")
    assert let_in(address, host=f"localhost:{port}", origin=f"http://localhost:{port}")
    for host, origin in [
        (address, "http://evil.example"),
        (address, "http://127.0.0.1:9"),
        (address, "null"),
        (address, ""),
        ("evil.example", "http://evil.example"),  # a name that leads here: DNS rebinding
        ("127.0.0.1.evil.example", "http://127.0.0.1.evil.example"),
    ]:
        assert not let_in(address, host=host, origin=origin), (host, origin)
        assert get(address, "/", host=host).status == (200 if host == address else 403)
    assert not let_in(address), "without an origin"


def test_a_network_demands_the_token(file):
    with running(StoredCube.open(file), token="secret") as address:
        own = {"origin": f"http://{address}"}
        assert not let_in(address, **own)
        for path in ("/", "/main.js", "/?token=", "/?token=wrong", "/main.js?token=secre"):
            assert get(address, path).status == 403, path
        answer = get(address, "/?token=secret")
        assert (answer.status, answer.headers["location"]) == (303, "/")
        cookie = answer.headers["set-cookie"]
        assert "httponly" in cookie.lower()
        brought = {"cookie": cookie.partition(";")[0]}
        assert get(address, "/", **brought).status == 200
        assert get(address, "/main.js", **brought).status == 200
        assert let_in(address, **own, **brought)
        assert not let_in(address, origin="http://evil.example", **brought)
        assert not let_in(address, **own, cookie=brought["cookie"] + "x")


def test_only_the_page_is_served(address, file):
    assert "script-src 'self'" in get(address, "/").headers["content-security-policy"]
    for path in [
        "/../server.py", "/%2e%2e/server.py", "/..%2fserver.py", "/page/main.js", "/server.py",
        f"/{file}", f"//{file}", f"/%2f{str(file)[1:]}", "/__init__.py", "/.", "/..%5cserver.py",
        "/main.js%00", "/doll.nc", "/socket",
    ]:  # fmt: skip
        assert get(address, path).status in (400, 403, 404), path


def test_the_page_fetches_nothing_from_elsewhere(address):
    page = Path(server.__file__).parent / "page"
    for path in page.iterdir():
        assert get(address, f"/{path.name}").read() == path.read_bytes()
        if path.suffix in (".js", ".css", ".html"):
            text = path.read_text().replace("http://www.w3.org/2000/svg", "")
            assert "http://" not in text, path
            assert "https://" not in text, path


def test_addresses():
    assert server.is_loopback("127.0.0.1")
    assert server.is_loopback("::1")
    assert server.is_loopback("localhost")
    for host in ("0.0.0.0", "192.168.1.5", "camera.lab", "::"):
        assert not server.is_loopback(host)
    with server.bind("127.0.0.1", 0) as taken:
        taken.listen()
        with pytest.raises(InputError, match=r"cannot be had.*--port"):
            server.bind("127.0.0.1", taken.getsockname()[1])


# --- those who misbehave ------------------------------------------------------------------------


def test_messages_are_bounded(address):
    page = Line(address)
    with pytest.raises(websockets.ConnectionClosed):
        page.ask(ask="reference", name="long", text="x" * (protocol.LARGEST + 8192))
    assert let_in(address, origin=f"http://{address}")


def deaf(address: str) -> socket.socket:
    """Return a WebSocket's line that nobody reads from."""
    host, port = address.split(":")
    line = socket.socket()
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    line.connect((host, int(port)))
    line.sendall(
        f"GET /socket HTTP/1.1\r\nHost: {address}\r\nOrigin: http://{address}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
    )
    assert line.recv(12) == b"HTTP/1.1 101"
    return line


def flood(line: socket.socket, opcode: int, payload: bytes) -> int:
    """Send frames and read nothing until no more are taken; return the bytes that were."""
    sent = 0
    line.settimeout(2)
    data = Frame(Opcode(opcode), payload, fin=opcode != Opcode.CONT).serialize(mask=True) * 64
    try:
        while sent < 32e6:
            line.sendall(data)
            sent += len(data)
    except OSError:  # full, or thrown out
        pass
    return sent


@pytest.mark.parametrize("kind", ["questions", "pings", "pieces"])
def test_one_who_floods_stops_nobody(address, cube, kind):
    """What it sends is not taken any more, or it is thrown out; the others are served."""
    ask = {"id": 1, "ask": "spectra", "regions": [[0, 0, 30, 40]] * 32}
    opcode, payload = {
        "questions": (Opcode.TEXT, json.dumps(ask).encode()),
        "pings": (Opcode.PING, b"x" * 125),
        "pieces": (Opcode.CONT, b""),
    }[kind]
    with deaf(address) as line:
        other = Line(address)
        if kind == "pieces":
            line.sendall(Frame(Opcode.TEXT, b"{", fin=False).serialize(mask=True))
        assert flood(line, opcode, payload) < 32e6
        header, band = other.ask(ask="picture", kind="band", band=9)
        np.testing.assert_array_equal(band[0], cube.values[..., 9])
        assert header["id"] == 7
        other.socket.close()


def test_pages_are_counted(address):
    pages = [Line(address) for _ in range(8)]
    refused = 0
    for _ in range(16):
        try:
            pages.append(Line(address))
        except websockets.InvalidStatus:
            refused += 1
    assert refused >= 8
    assert get(address, "/").status == 200
    for page in pages:
        page.socket.close()
    assert let_in(address, origin=f"http://{address}")


# --- references ---------------------------------------------------------------------------------


def test_references_of_all_dialects(tmp_path):
    for text in (
        "wavelength,red paint,blue paint\n500,0.1,0.5\n600,0.2,0.4\n",
        "wavelength;red paint;blue paint\n500;0.1;0.5\n600;0.2;0.4\n",
        '"nm"\t"red paint"\t"blue paint"\n600\t0.2\t0.4\n500\t0.1\t0.5\n',
        "# measured today\nnm,red paint,blue paint\n\n0.5,0.1,0.5\n0.6,0.2,0.4\n",
    ):
        (tmp_path / "paint.csv").write_text("\ufeff" + text, encoding="utf-8")
        red, blue = read_references(tmp_path / "paint.csv")
        assert (red["name"], blue["name"]) == ("red paint", "blue paint")
        np.testing.assert_allclose(red["wavelength"], [500, 600])
        assert (red["values"], blue["values"]) == ([0.1, 0.2], [0.5, 0.4])
    (bare,) = parse_references("500 1\n510 2\n", "grass.txt")
    assert bare["name"] == "grass"


@pytest.mark.parametrize(
    "text",
    ["", "a,b\n", "500,1\n", "500,1\n500,2\n", "500,1\n510\n", "500,1\n510,x\n", "500,1\n510,nan\n",
     "500\n510\n", "inf,1\n510,2\n", ",".join("1" * 80) + "\n" + ",".join("2" * 80)],
)  # fmt: skip
def test_references_that_are_none(text):
    with pytest.raises(InputError, match="paint"):
        parse_references(text, "paint.csv")


# --- the command --------------------------------------------------------------------------------


def test_command_refuses_what_is_no_cube(tmp_path, file):
    bad = tmp_path / "bad.nc"
    bad.write_bytes(b"no cube")
    for arguments, reason in [
        ([bad], "bad.nc cannot be read as NetCDF"),
        ([bad, tmp_path / "missing.nc"], "None of these files is a cube"),
        ([Path(__file__)], "none of the scenes"),
        ([file, "--reference", bad], "bad.nc"),
    ]:
        result = CliRunner().invoke(app, ["view", "--no-browser", *map(str, arguments)])
        assert isinstance(result.exception, InputError)
        assert reason in str(result.exception)
    with server.bind("127.0.0.1", 0) as taken:
        taken.listen()
        port = taken.getsockname()[1]
        result = CliRunner().invoke(app, ["view", "--no-browser", "--port", str(port), str(file)])
    assert f"The port {port}" in str(result.exception)
