"""How fast recordings are read and imported, against the libraries alone, and how memory grows with their length."""

import dataclasses
import lzma
import re
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import cv2
import laspy
import numpy as np
import velodyne_decoder as vd
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image
from rosbags.rosbag2 import Reader, Writer

from streetscan.drives import Recording, import_drive, read_drive_facts
from streetscan.frames import LidarFrame
from streetscan.io.mcap import iterate_lidar
from streetscan.io.pcap import MODELS
from streetscan.io.rosbags import velodyne_typestore

ROOT = Path(__file__).resolve().parents[1]
SCHEMA = ROOT / "config" / "drive.schema.yaml"


def bench_drives(data_root: str | Path, n_repeats: int = 3) -> list[dict]:
    """Throughput of the readers and of the whole import on the recordings at hand, and memory over length.

    Args:
        data_root: folder of the recordings; those that are missing are left out.
        n_repeats: each time is the best of so many.
    Returns:
        rows benchmark, metric, value, unit, peer, n. A ratio is our time over the library's, measured in turn in one run.
    """
    data_root = Path(data_root)
    rows = []
    for name, (peer, alone) in _PEERS.items():
        facts = read_drive_facts(ROOT / "config" / "drives" / f"{name}.yaml", SCHEMA)
        path = data_root / facts.root
        if not path.exists():
            continue
        with tempfile.TemporaryDirectory() as folder:
            root = data_root
            # rosbags cannot open the other bag, which names no serialization format; its scans are fourteen times as large.
            if name == "nebula_vlp16":
                path, root = _lengthen_bag(path, Path(folder) / "bag", 25), Path(folder)
                facts = dataclasses.replace(facts, root="bag")
            rows += _bench_reader(name, peer, alone, Recording(facts, root), path, n_repeats)
    return rows + _bench_memory()


def _lengthen_bag(path: Path, longer: Path, n_times: int) -> Path:
    """The bag's messages over and over, for the recordings at hand hold four scans, less than opening a bag takes."""
    store = velodyne_typestore()
    with Reader(path) as reader, Writer(longer, version=9) as writer:
        messages = [(c, t, bytes(data)) for c, t, data in reader.messages()]
        connection = writer.add_connection(messages[0][0].topic, messages[0][0].msgtype, typestore=store)
        for i in range(n_times):
            for _, time_ns, data in messages:
                writer.write(connection, time_ns + i * 10**9, data)
    return longer


def _bench_reader(name: str, peer: str, alone: Callable, recording: Recording, path: Path, n_repeats: int) -> list[dict]:
    ours_s, alone_s, import_s, read_s, library_s = [], [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        mcap = Path(folder) / "drive.mcap"
        for _ in range(n_repeats):
            ours_s.append(_time(lambda: _exhaust(recording.records())))
            alone_s.append(_time(lambda: _exhaust(alone(path))))
            import_s.append(_time(lambda: import_drive(recording, name, mcap, mcap.with_suffix(".csv"), Path(folder) / "truth")))
            read_s.append(_time(lambda: _exhaust(iterate_lidar(mcap))))
            library_s.append(_time(lambda: _exhaust(_mcap_alone(mcap))))
        n = sum(1 for _ in iterate_lidar(mcap))
    return [
        _row(f"read_{name}", "throughput", n / min(ours_s), "frames/s", "", n),
        _row(f"read_{name}", "throughput", n / min(alone_s), "frames/s", peer, n),
        _row(f"read_{name}", "time_ratio", min(ours_s) / min(alone_s), "1", peer, n),
        _row(f"import_{name}", "throughput", n / min(import_s), "frames/s", "", n),
        _row(f"read_mcap_{name}", "throughput", n / min(read_s), "frames/s", "", n),
        _row(f"read_mcap_{name}", "time_ratio", min(read_s) / min(library_s), "1", "mcap", n),
    ]


def _bench_memory() -> list[dict]:
    """Peak memory of whole processes that import 100 and 1000 frames of 20 000 points."""
    peaks_mb = {}
    for n_frames in (100, 1000):
        code = f"from benchmarks.bench_drives import _import_synthetic; print(_import_synthetic({n_frames}))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
        peaks_mb[n_frames] = float(done.stdout.split()[-1])
    rows = [_row("import_synthetic", "peak_memory", peak, "MB", "", n) for n, peak in peaks_mb.items()]
    return [*rows, _row("import_synthetic", "memory_ratio", peaks_mb[1000] / peaks_mb[100], "1", "100 frames", 1000)]


def _import_synthetic(n_frames: int, n_points: int = 20_000) -> float:
    """Peak resident memory in MB after an import of made-up scans."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "velodyne").mkdir()
        scan = np.random.default_rng(0).random((n_points, 4), np.float32)
        for i in range(n_frames):
            scan.tofile(folder / "velodyne" / f"{i:06d}.bin")
        facts = "description: d\nsource: s\nreader: folder\nroot: .\nrate_hz: 10\nlidar: {files: velodyne/*.bin}\n"
        (folder / "synthetic.yaml").write_text(facts)
        recording = Recording(read_drive_facts(folder / "synthetic.yaml", SCHEMA), folder)
        import_drive(recording, "synthetic", folder / "d.mcap", folder / "f.csv", folder / "truth")
    return peak_memory_mb()


def peak_memory_mb() -> float:
    """The most resident memory this process has had since its program was loaded.

    getrusage will not do: its maximum is inherited from the process that started this one.
    """
    status = Path("/proc/self/status").read_text()
    return int(re.search(r"^VmHWM:\s*(\d+) kB", status, re.MULTILINE)[1]) / 1024


def _kitti_alone(path: Path) -> Iterable:
    for scan in sorted((path / "velodyne_points" / "data").glob("*.bin")):
        yield np.fromfile(scan, np.float32).reshape(-1, 4)
        Image.open(path / "image_02" / "data" / f"{scan.stem}.png").verify()


def _laz_alone(path: Path) -> Iterable:
    for scan in sorted((path / "velodyne_laz").glob("*.laz")):
        yield laspy.read(scan).xyz


def _png_alone(path: Path) -> Iterable:
    for image in sorted((path / "data").glob("*.png")):
        yield cv2.imread(str(image), cv2.IMREAD_UNCHANGED)


def _pcap_alone(path: Path) -> Iterable:
    yield from vd.read_pcap(path, vd.Config(model=MODELS["hdl32e"]))


def _xz_alone(path: Path) -> Iterable:
    for number in range(10):
        yield np.frombuffer(lzma.decompress((path / "velodyne" / f"{number:06d}.bin.xz").read_bytes()), np.float32).reshape(-1, 4)
        np.frombuffer(lzma.decompress((path / "labels" / f"{number:06d}.label.xz").read_bytes()), np.uint32)
        Image.open(path / "image_2" / f"{number:06d}.png").verify()


def _bag_alone(path: Path) -> Iterable:
    with Reader(path) as reader:
        yield from _packets_alone(((c.msgtype, data) for c, _, data in reader.messages()), "vlp16")


def _sqlite_alone(path: Path) -> Iterable:
    with closing(sqlite3.connect(f"file:{next(path.glob('*.db3'))}?immutable=1", uri=True)) as database:
        rows = database.execute("SELECT data FROM messages ORDER BY timestamp")
        yield from _packets_alone((("velodyne_msgs/msg/VelodyneScan", data) for (data,) in rows), "vls128")


def _packets_alone(messages: Iterable[tuple[str, bytes]], model: str) -> Iterable:
    store, decoder = velodyne_typestore(), vd.StreamDecoder(vd.Config(model=MODELS[model]))
    for msgtype, data in messages:
        for packet in store.deserialize_cdr(data, msgtype).packets:
            decoder.decode(packet.stamp.sec + packet.stamp.nanosec * 1e-9, packet.data.tobytes())
        yield None


def _mcap_alone(path: Path) -> Iterable:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        yield from reader.iter_decoded_messages(topics=["/lidar"])


_PEERS = {
    "kitti_0005": ("numpy.fromfile and Pillow's verify", _kitti_alone),
    "kitti_0001": ("laspy", _laz_alone),
    "semantickitti": ("lzma, numpy and Pillow's verify", _xz_alone),
    "muehlburger_tor": ("cv2.imread", _png_alone),
    "hdl32_capture": ("velodyne_decoder", _pcap_alone),
    "nebula_vlp16": ("rosbags and velodyne_decoder", _bag_alone),
    "nebula_vls128": ("sqlite3 and velodyne_decoder", _sqlite_alone),
}


def _exhaust(items: Iterable) -> int:
    return sum(len(item) if isinstance(item, LidarFrame) else 1 for item in items)


def _time(work: Callable) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _row(benchmark: str, metric: str, value: float, unit: str, peer: str, n: int) -> dict:
    return {"benchmark": benchmark, "metric": metric, "value": value, "unit": unit, "peer": peer, "n": n}


if __name__ == "__main__":
    for row in bench_drives(sys.argv[1] if len(sys.argv) > 1 else ROOT.parent / "shared" / "data"):
        print("{benchmark:<28} {metric:<13} {value:>10.3f} {unit:<9} {peer:<32} {n}".format(**row))
