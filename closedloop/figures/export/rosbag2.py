"""A run as a bag of ROS 2: a folder with the messages of `write_mcap` and the metadata that `ros2 bag` reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from closedloop.base.files import made_folder, write_whole
from closedloop.figures.export.mcap_file import write_mcap
from closedloop.record.run import Run

# Of metadata.yaml: the version that ROS 2 Humble and all later ones read.
VERSION = 5


def write_rosbag2(run: Run, path: str | Path) -> list[Path]:
    """Write a run as a bag, the folder `path`, for ``ros2 bag play`` and ``ros2 bag info``; return what was written.

    Raises
    ------
    ScenarioError
        If the package mcap-ros2-support is missing.
    OutputError
        If the folder cannot be made or written into.
    """
    folder = Path(path)
    name = f"{folder.name}_0.mcap"
    written = write_mcap(run, made_folder(folder) / name)
    import yaml

    text = yaml.safe_dump({"rosbag2_bagfile_information": _information(written[0])}, sort_keys=False)
    return [*written, write_whole(folder / "metadata.yaml", text.encode())]


def _information(path: Path) -> dict[str, Any]:
    """Return what the metadata say of an MCAP file."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        summary: Any = make_reader(file).get_summary()
    counts, numbers = summary.statistics, summary.statistics.channel_message_counts
    spans = {
        "starting_time": {"nanoseconds_since_epoch": counts.message_start_time},
        "duration": {"nanoseconds": counts.message_end_time - counts.message_start_time},
        "message_count": counts.message_count,
    }
    topics = [
        {
            "topic_metadata": {
                "name": channel.topic, "type": summary.schemas[channel.schema_id].name,
                "serialization_format": channel.message_encoding, "offered_qos_profiles": "",
            },
            "message_count": numbers[number],
        }
        for number, channel in summary.channels.items()
    ]  # fmt: skip
    return {
        "version": VERSION, "storage_identifier": "mcap", **spans, "topics_with_message_count": topics,
        "compression_format": "", "compression_mode": "", "relative_file_paths": [path.name],
        "files": [{"path": path.name, **spans}],
    }  # fmt: skip
