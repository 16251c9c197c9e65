# SPDX-License-Identifier: Apache-2.0
"""The files in ``deploy/``: the server behind nginx and Caddy, what describes containers, and the units."""

import gzip
import re
import shutil
import subprocess
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from structgstream.cli.app import TERMINATED
from structgstream.cli.options import parse_known_options
from structgstream.cli.reconstruct import Reconstruct
from structgstream.codec.segments.quality_list import ListedQuality, write_list
from structgstream.serve.access import TokenKeys
from structgstream.serve.app import ServerSettings
from structgstream.serve.listening import LOOPBACK_NAMES
from tests.support.segment_folders import GrowingFolder
from tests.support.serving import Served, free_port, hosted, nginx, started
from tests.support.streams import small_stream
from tests.support.waiting import wait_until

DEPLOY = Path(__file__).parents[2] / "deploy"
NAME = "live.example.org"
STREAM = small_stream(7)
PATIENCE_SECONDS = 30.0


@contextmanager
def deployed_nginx(folder: Path, upstream: int) -> Iterator[Served]:
    """``deploy/nginx.conf`` with other places, and without TLS."""
    port = free_port()
    site = (DEPLOY / "nginx.conf").read_text()
    for written, here in (
        ("listen 443 ssl", f"listen 127.0.0.1:{port}"),
        ("server 127.0.0.1:8080", f"server 127.0.0.1:{upstream}"),
        ("/var/cache/nginx", str(folder)),
        ("/var/log/nginx", str(folder)),
    ):
        assert site.count(written) == 1, written
        site = site.replace(written, here)
    site = re.sub(r"ssl_certificate\w* [^;]+;", "", site)
    with nginx(folder, port, site) as running:
        yield running


@contextmanager
def caddy(folder: Path, upstream: int) -> Iterator[Served]:
    """``deploy/Caddyfile`` with another place, and without TLS."""
    port = free_port()
    text = (DEPLOY / "Caddyfile").read_text()
    assert text.count(f"{NAME} {{") == 1
    text = text.replace(f"{NAME} {{", f"http://{NAME} {{\n\tbind 127.0.0.1")
    assert text.count("\tlog {") == 1
    here = f"\tadmin off\n\thttp_port {port}\n\tlog {{\n\t\toutput file {folder}/structgstream.log"
    (folder / "Caddyfile").write_text(text.replace("\tlog {", here))
    command = ["caddy", "run", "--config", str(folder / "Caddyfile"), "--adapter", "caddyfile"]
    places = {"XDG_DATA_HOME": str(folder), "XDG_CONFIG_HOME": str(folder), "UPSTREAM": f"127.0.0.1:{upstream}"}
    with started(command, port, folder, **places) as running:
        yield running


PROXIES = {"nginx": deployed_nginx, "caddy": caddy}


@pytest.fixture(params=sorted(PROXIES))
def proxy(request: pytest.FixtureRequest) -> str:
    if shutil.which(request.param) is None:
        pytest.skip(f"there is no {request.param} on this machine")
    return request.param


@contextmanager
def behind(proxy: str, streams: Path, work: Path, *, keys: TokenKeys | None = None) -> Iterator[tuple[Served, Served]]:
    """The server and the proxy in front of it, whose files are in ``work``."""
    settings = ServerSettings(streams, hosts=(*LOOPBACK_NAMES, NAME), keys=keys)
    with hosted(settings, proxies=("127.0.0.1",)) as server, PROXIES[proxy](work, server.port) as front:
        yield server, front


def test_a_live_stream_behind_a_proxy(tmp_path: Path, proxy: str) -> None:
    growing = GrowingFolder(tmp_path / "streams" / "studio", STREAM)
    for _ in range(5):
        growing.write()
    assert growing.manifest is not None
    low = GrowingFolder(tmp_path / "streams" / "show" / "low", STREAM)
    write_list(tmp_path / "streams" / "show", [ListedQuality("low", "low/manifest.json", 1e6)])
    places = tmp_path / "proxy"
    places.mkdir()
    with behind(proxy, tmp_path / "streams", places) as (server, front):

        def ask(path: str, **headers: str):
            return front.ask(path, Host=NAME, **headers)

        page = ask("/streams/studio/")
        assert (page.status, "structgstream-player" in page.body.decode()) == (200, True)
        assert ask("/streams/studio").headers["location"] == "studio/"
        answer = ask("/streams/studio/manifest.json")
        assert ask("/streams/studio/manifest.json", If_None_Match=answer.headers["etag"]).status == 304
        zipped = ask("/streams/studio/manifest.json", Accept_Encoding="gzip")
        assert gzip.decompress(zipped.body) == answer.body
        assert ask("/streams/studio/manifest.json", If_None_Match=zipped.headers["etag"]).status == 304
        segment = growing.manifest.segments[0]
        content = (tmp_path / "streams" / "studio" / segment.file).read_bytes()
        address = f"/streams/studio/{segment.file}"
        part = ask(address, Range="bytes=3-9")
        assert (part.status, part.body) == (206, content[3:10])
        assert ask(address).body == content
        assert "immutable" in ask(address).headers["cache-control"]
        if proxy == "nginx":
            assert ask(address).headers["x-cache"] == "HIT"
        # So it is with the files of a quality.
        part = f"/streams/show/low/{low.write().parts[0].file}"
        wait_until(lambda: ask(part).status != 404, seconds=PATIENCE_SECONDS)
        if proxy == "nginx":
            assert ask(part).headers["x-cache"] == "HIT"
        # Waiting goes through the proxy.
        with ThreadPoolExecutor(1) as pool:
            waiting = pool.submit(ask, "/streams/studio/manifest.json?after=5")
            while 'structgstream_waiters{stream="studio"} 1.0' not in server.ask("/metrics").body.decode():
                assert not waiting.done()
            growing.write()
            assert b'"sequence":6' in waiting.result(PATIENCE_SECONDS).body
        assert ask("/metrics").status == 404
        assert ask("/streams/../../../etc/passwd").status in (400, 404)
        assert front.ask("/", Host="evil.example").status in (200, 400, 404)  # never a stream
        assert b"studio" not in front.ask("/", Host="evil.example").body


def test_a_proxy_states_the_client_and_a_client_cannot(tmp_path: Path, proxy: str) -> None:
    GrowingFolder(tmp_path / "streams" / "studio", STREAM).write_all()
    with behind(proxy, tmp_path / "streams", tmp_path) as (server, front):
        for number in range(5):
            front.ask("/streams/studio/manifest.json", Host=NAME, X_Forwarded_For=f"198.51.100.{number}")
        assert 'structgstream_viewers{stream="studio"} 1.0' in server.ask("/metrics").body.decode()


def test_nginx_bounds_the_requests_of_an_address(tmp_path: Path) -> None:
    if shutil.which("nginx") is None:
        pytest.skip("there is no nginx on this machine")
    (tmp_path / "streams").mkdir()
    with behind("nginx", tmp_path / "streams", tmp_path) as (_, front), ThreadPoolExecutor(20) as pool:
        statuses = [*pool.map(lambda _: front.ask("/health", Host=NAME).status, range(400))]
    assert set(statuses) == {200, 429}
    assert statuses.count(200) >= 200


def test_tokens_do_not_reach_the_log(tmp_path: Path, proxy: str) -> None:
    keys = TokenKeys((b"a secret of thirty-two characters",))
    GrowingFolder(tmp_path / "streams" / "studio", STREAM).write_all()
    token = keys.token("studio", expires_unix_seconds=int(time.time()) + 600)
    with behind(proxy, tmp_path / "streams", tmp_path, keys=keys) as (_, front):
        for _ in range(2):
            answer = front.ask(f"/streams/studio/manifest.json?token={token}", Host=NAME)
            assert answer.status == 200
        assert front.ask(f"/streams/studio?token={token}", Host=NAME).status == 307
        file = next((tmp_path / "streams" / "studio").glob("segment-*")).name
        assert front.ask(f"/streams/studio/{file}?token={token}", Host=NAME).status == 200
        # What one was shown is not shown to another.
        assert front.ask(f"/streams/studio/{file}", Host=NAME).status == 401
        assert front.ask(f"/streams/studio/{file}", Host=NAME, Authorization=f"Bearer {token}").status == 200
        assert front.ask(f"/streams/studio/{file}", Host=NAME).status == 401
    log = (tmp_path / "structgstream.log").read_text()
    assert "manifest.json" in log
    assert token.split(".")[2] not in log


def test_tokens_do_not_reach_the_log_of_a_server_that_is_down(tmp_path: Path, proxy: str) -> None:
    with PROXIES[proxy](tmp_path, free_port()) as front:
        address = "/streams/studio/manifest.json?token=abcdefgh"
        assert front.ask(address, Host=NAME, Authorization="Bearer abcdefgh").status == 502
    logs = b"".join(path.read_bytes() for path in tmp_path.iterdir() if path.is_file())
    assert b"manifest.json" in logs
    assert b"abcdefgh" not in logs


def test_the_compose_file_and_the_image() -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    serve = compose["services"]["serve"]
    assert (DEPLOY / serve["build"]["context"] / serve["build"]["dockerfile"]).resolve() == DEPLOY / "Dockerfile"
    assert "ports" not in serve  # only the proxy is reached from outside
    assert serve["command"][serve["command"].index("--proxy") + 1] in str(compose["networks"])
    assert "--secret-file" in serve["command"]


def test_the_image_copies_what_is_there_and_installs_what_the_server_needs() -> None:
    lines = (DEPLOY / "Dockerfile").read_text().splitlines()
    kept = [
        line[1:].removesuffix("/**")
        for line in (DEPLOY / "Dockerfile.dockerignore").read_text().splitlines()
        if line.startswith("!")
    ]
    copied = [source for line in lines if line.startswith("COPY ") for source in line.split()[1:-1]]
    assert sorted(copied) == sorted(kept)
    assert all((DEPLOY.parent / source).exists() for source in copied)
    project = tomllib.loads((DEPLOY.parent / "pyproject.toml").read_text())["project"]
    wanted = {*project["dependencies"], *project["optional-dependencies"]["serve"]}
    (install,) = (line for line in lines if line.startswith("RUN pip install"))
    installed = re.findall(r'"([^"]+)"', install)
    assert {"starlette", "uvicorn"} <= {re.split("[>=]", one)[0] for one in installed}
    assert all(one in wanted for one in installed)


def test_the_image_is_built() -> None:
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "info"], capture_output=True, check=False).returncode:
        pytest.skip("there is no docker on this machine, or it does not run")
    root = DEPLOY.parent
    build = [docker, "build", "-q", "-f", str(DEPLOY / "Dockerfile"), str(root)]
    assert subprocess.run(build, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("service", ["serve", "live"])
def test_the_units_are_such(tmp_path: Path, service: str) -> None:
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("there is no systemd on this machine")
    unit = tmp_path / f"structgstream-{service}.service"
    text = (DEPLOY / unit.name).read_text()
    assert "/opt/structgstream/bin/structgstream" in text
    unit.write_text(text.replace("/opt/structgstream/bin/structgstream", "/bin/true"))
    found = subprocess.run([program, "verify", unit], capture_output=True, text=True, check=False)
    assert unit.name not in found.stderr


def test_the_unit_of_a_live_run_says_what_the_command_takes_and_how_it_ends() -> None:
    text = (DEPLOY / "structgstream-live.service").read_text().replace("\\\n", " ")
    (line,) = re.findall(r"^ExecStart=\S+ reconstruct (.*)$", text, re.MULTILINE)
    options, rest = parse_known_options(Reconstruct, "reconstruct", arguments=line.split())
    assert not rest
    assert (options.live.live, options.resume, options.segments.sink) == (True, True, "segments")
    assert f"SuccessExitStatus={TERMINATED}\n" in text
