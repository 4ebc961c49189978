"""What must hold of the whole program: two threads, no network, the same input twice."""

import os
import re
import subprocess
import sys

import pytest

from calib.batch import cluster
from calib.session import SessionError

THREADS = """
import faulthandler, sys, threading, time
faulthandler.dump_traceback_later(int(sys.argv[1]), exit=True)
import jax
jax.config.update("jax_enable_x64", True)
import equinox as eqx, jax.numpy as jnp, numpy as np
import jaxeit as je
from calib.fitting.curves import PowerLaw
from calib.fitting.curves import fit_curves
from calib.fitting.fields import GaussianProcess, fit_field, geometry_of, single_places

skin, rng = je.load_skin("testbed"), np.random.default_rng(0)
model = je.discretise(je.Scene(skin), je.Fidelity.draft(edge_length=0.03))
recon = je.prepare(model, basis=je.Pixels(12))
finder = je.prepare_contacts(model, noise=np.full(550, 1e-6))
pressure = rng.uniform(50, 4000, (4, 5400))
groups, places = np.repeat(np.arange(225), 24), single_places(rng.uniform(0.01, 0.19, (60, 2)), 4)
share, reach = jnp.full((60, 4), 0.25), jnp.array([[0, 0], [0.2, 0.2]])
field = eqx.filter_jit(fit_field)
touches = rng.normal(size=(16, 550)) * 1e-5
geometry, ratio = geometry_of(skin), jnp.asarray(rng.normal(0, 0.1, 60))
CALLS = [
    lambda: recon(np.zeros(550)),
    lambda: recon(np.zeros((64, 550))),
    lambda: je.forward(model),
    lambda: finder(touches),
    lambda: fit_curves(PowerLaw(2000.0), pressure, 4e-3 * pressure, groups=groups).parameters,
    lambda: field(GaussianProcess(), geometry, places, ratio, share, jnp.ones(60), reach).coefficients,
]
def values(call):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(CALLS[call]())]

alone = [values(call) for call in range(len(CALLS))]
same, until = [], time.monotonic() + 20

def work(first):
    for k in range(150):
        if k < len(CALLS) or time.monotonic() < until:
            call = (first + k) % len(CALLS)
            pairs = zip(values(call), alone[call], strict=True)
            same.append(all(np.array_equal(*pair, equal_nan=True) for pair in pairs))

threads = [threading.Thread(target=work, args=(first,)) for first in (0, 3)]
[thread.start() for thread in threads]
[thread.join() for thread in threads]
print(sum(same), len(same))
"""


@pytest.mark.slow
def test_two_threads_never_wait_for_each_other_for_ever(root, hard):
    """On jaxlib 0.10.2 two programs with large stacks of LAPACK calls do; none of ours has such a stack."""
    command = [sys.executable, "-c", THREADS, "400"]  # seconds until it shows where it hangs, and ends
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    same, count = map(int, done.stdout.split())
    assert same == count >= 12
    hard(
        "two threads of Python",
        "300 calls, at most 20 s, of images, forward solves, contacts and fits",
        beyond="no call hangs, results have the bits of one thread; your own large stacks of QR or SVD may hang",
    )


OFFLINE = """
import socket, sys

class Refused(OSError):
    pass

def refuse(*_, **__):
    raise Refused("the network was asked for")

socket.socket.connect = socket.socket.connect_ex = socket.socket.bind = refuse
socket.getaddrinfo = socket.create_connection = refuse
from calib.cli import main
sys.exit(main(sys.argv[1:]))
"""


def offline(root, *words):
    """What a command prints in a process without network."""
    command = [sys.executable, "-c", OFFLINE, *map(str, words)]
    environment = os.environ | {"http_proxy": "http://192.0.2.1:9"}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
def test_without_network_the_same_input_gives_the_same_json(root, bundled, tmp_path, hard):
    grid, presses = sorted(bundled, key=lambda path: "grid" not in path.stem)
    said = []
    for name in ("one", "other"):
        (folder := tmp_path / name).mkdir()
        outputs = ["-o", folder / "calibration.h5", "--report", folder / "report.html"]
        said.append(
            (
                offline(root, "calibrate", grid, "--test", presses, "--pixels", 20, "--json", *outputs),
                offline(root, "evaluate", folder / "calibration.h5", presses, "--json"),
                offline(root, "check", presses, "--json"),
            )
        )
    assert said[0] == said[1]
    assert all(text.lstrip().startswith("{") for text in said[0])
    page = (tmp_path / "one" / "report.html").read_text()
    loads = r"""(?:src|href|action)\s*=\s*["']?(?!data:|#)([^"'\s>]+)|url\((?!["']?(?:data:|#))|@import"""
    assert [found[0] for found in re.finditer(loads, page)] == []
    hard(
        "no network, the same input twice",
        "calibrate, evaluate and check in processes that cannot connect",
        beyond="the same JSON byte for byte; a report that requests nothing from a network",
    )


def test_a_scheduler_that_does_not_answer_is_one_line(monkeypatch):
    def silent(*_, **__):
        raise OSError("timed out\nafter 10 s")

    monkeypatch.setattr(cluster, "Client", silent)
    said = r"^tcp://x:1: no Dask scheduler answers there \(timed out after 10 s\); start one: dask scheduler$"
    with pytest.raises(SessionError, match=said), cluster.dask_executor("tcp://x:1"):
        pass
