"""Writes a LeRobot dataset: atomic, resumable, in parallel, the same bytes for the same episodes."""

from __future__ import annotations

import json
import os
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.closing import Closing
from roboxim_core.errors import InvalidRequestError
from roboxim_core.vision.images import PNG_COMPRESSION, encode_image
from roboxim_datasets.build import ResumableBuild, write_files
from roboxim_datasets.episode import Episode, Step
from roboxim_datasets.lerobot.assemble import assemble
from roboxim_datasets.lerobot.content import LeRobotContent
from roboxim_datasets.lerobot.layout import (
    DEPTH_UNIT_M,
    INFO_FILE,
    MAX_DEPTH,
    MODALITY_FILE,
    ROBOXIM_FILE,
    LeRobotLayout,
)
from roboxim_datasets.lerobot.modality import modality
from roboxim_datasets.lerobot.pieces import SAMPLE, Array, Piece, image_column, numbers_table, sample_column
from roboxim_datasets.statistics import ImageStatistics
from roboxim_datasets.video.client import VideoFile, VideoWriters, VideoWriting

_SAMPLES = 8  # sampled pixels of depth and segmentation, a side
_UNDER_WAY = 4  # episodes whose videos may still be encoding while the next one is read


class LeRobotWriter(Closing):
    """Writes a dataset; a context manager that ends its video workers.

    Non-obvious: after an interruption the next writer of the same ``identity`` keeps the finished episodes; the caller
    skips the first ``resumed(split)`` episodes of each split.
    """

    def __init__(
        self,
        path: Path,
        layout: LeRobotLayout,
        content: LeRobotContent,
        *,
        identity: str = "",
        overwrite: bool = False,
        workers: int = 0,
    ) -> None:
        """Start a dataset, or continue an interrupted one of the same identity.

        Args:
            path: Folder of the dataset.
            layout: Layout of the dataset.
            content: Where the parts of an episode go.
            identity: Distinguishes this build from others; empty: never resumed.
            overwrite: Whether an existing dataset is replaced at the end.
            workers: Processes that encode videos; 0: one for each core, at most 4.

        Raises:
            RecorderError: With code ``EXPORT_REFUSED`` when the folder exists and must stay.
        """
        self.layout, self.content = layout, content
        self._build = ResumableBuild(path, identity=identity, overwrite=overwrite, marker=INFO_FILE)
        self._videos = VideoWriters(workers or min(4, os.cpu_count() or 1))
        self._under_way: deque[tuple[dict[str, Any], dict[str, Future[VideoFile]]]] = deque()

    def resumed(self, split: str) -> int:
        """Return the number of episodes of a split that an interrupted build has written."""
        return self._build.resumed(split)

    def add(self, split: str, episode: Episode) -> None:
        """Append an episode to a split. The videos of the last few episodes are finished in the background.

        Raises:
            InvalidRequestError: When the episode does not fit the layout.
            RecorderError: When the episode cannot be read or a video not be written.
            OSError: When the disk is full.
        """
        number = self.resumed(split) + sum(facts["split"] == split for facts, _ in self._under_way)
        videos = self._open_videos(split, number) if self.layout.codec else {}
        collected = _Collected(self.layout, self.content, videos)
        content = self.content
        maps = {"depth": content.depth.values(), "segmentation": content.segmentation.values()}
        for step in episode.steps(content.cameras.values(), **maps):
            collected.add(step)
            collected.subtasks.append(episode.subtask(step))
        piece = collected.piece(episode)
        piece.write(self._build.piece(split, number, "rows.arrow"))
        facts: dict[str, Any] = {
            "split": split, "number": number, "length": len(piece), "instruction": episode.instruction
        }  # fmt: skip
        if episode.instructions:
            facts |= {"instructions": list(episode.instructions), "spoken": collected.instructions}
        if self.layout.subtasks:
            facts |= {"subtasks": collected.subtasks}
        self._under_way.append((facts, {key: video.close() for key, video in videos.items()}))
        self._settle(_UNDER_WAY)

    def _open_videos(self, split: str, number: int) -> dict[str, VideoWriting]:
        return {
            key: self._videos.open(
                self._build.piece(split, number, f"{key}.mp4"),
                codec=self.layout.codec,
                rate=Fraction(self.layout.fps),
                height=size.height,
                width=size.width,
            )
            for key, size in self.layout.cameras.items()
        }

    def _settle(self, max_pending: int) -> None:
        """Wait until at most ``max_pending`` episodes are under way, and note the finished ones in their order."""
        while self._under_way and (
            len(self._under_way) > max_pending or all(future.done() for future in self._under_way[0][1].values())
        ):
            facts, futures = self._under_way.popleft()
            sizes = {key: future.result().size for key, future in futures.items()}
            self._build.commit({**facts, "videos": sizes})

    def complete(self, files: Mapping[str, str | bytes]) -> None:
        """Finish the dataset and move it to its final place.

        Args:
            files: Further files by name, e.g. a README.

        Raises:
            RecorderError: ``EXPORT_REFUSED`` when there is no episode.
            OSError: When the disk is full.
        """
        self._settle(0)
        layout, content = self.layout, self.content
        assemble(self._build, layout, self._videos)
        own = {MODALITY_FILE: modality(layout, content), ROBOXIM_FILE: content.to_json()}
        texts = {name: json.dumps(value, indent=2) + "\n" for name, value in own.items()}
        write_files(self._build.staged, {**texts, **files})
        self._build.finish()

    def close(self) -> None:
        """End the video workers; what is not complete stays resumable."""
        self._videos.close()


class _Collected:
    """Steps of an episode on their way into a piece and its videos."""

    def __init__(self, layout: LeRobotLayout, content: LeRobotContent, videos: Mapping[str, VideoWriting]) -> None:
        self._layout, self._content, self._videos = layout, content, videos
        self._rows: dict[str, list[Any]] = {key: [] for key in layout.columns}
        self._encoded: dict[str, list[bytes]] = {key: [] for key in (*layout.depth, *layout.cameras)}
        self.instructions: list[str | None] = []
        """Instruction of each step; None: the episode's."""
        self.subtasks: list[str] = []
        """Subtask of each step."""
        self._samples: dict[str, list[Array]] = {key: [] for key in layout.depth}
        self._statistics = {key: ImageStatistics() for key in layout.cameras}

    def add(self, step: Step) -> None:
        """Take a step."""
        self.instructions.append(step.instruction)
        names, content = self._content.names, self._content
        values: dict[str, Any] = {names.action: step.action, names.reward: step.reward, names.done: False}
        values |= {key: step.vector(vector) for key, vector in content.vectors.items()}
        values |= {key: step.signal(signal) for key, signal in content.signals.items()}
        for key in self._layout.columns:
            self._rows[key].append(values[key])
        for key, camera in content.cameras.items():
            self._image(key, step.images[camera])
        for key, camera in content.depth.items():
            scaled = np.nan_to_num(step.depth[camera] / DEPTH_UNIT_M, nan=0.0, posinf=0.0, neginf=0.0)
            known = (scaled > 0) & (scaled <= MAX_DEPTH)  # others' -1 means that there is no value
            self._map(key, np.where(known, np.rint(scaled), 0).astype(np.uint16))
        for key, camera in content.segmentation.items():
            self._map(key, step.segmentation[camera])

    def _image(self, key: str, image: Array) -> None:
        self._statistics[key].add(image[None])
        if key in self._videos:
            self._videos[key].add(image)
        else:
            self._encoded[key].append(encode_image(image, "png"))

    def _map(self, key: str, values: Array) -> None:
        """Take an image of depth or segmentation, uint16; the nearest pixels are taken when the size differs."""
        import cv2

        size = self._layout.depth[key]
        if values.shape != (size.height, size.width):
            resized = cv2.resize(values, (size.width, size.height), interpolation=cv2.INTER_NEAREST_EXACT)
            values = np.asarray(resized, np.uint16)
        done, data = cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])
        if not done:
            raise InvalidRequestError(f"OpenCV cannot encode '{key}' of shape {values.shape} as PNG")
        self._encoded[key].append(bytes(data))
        rows, columns = (np.linspace(0, side - 1, _SAMPLES).astype(int) for side in values.shape)
        self._samples[key].append(values[np.ix_(rows, columns)])

    def piece(self, episode: Episode) -> Piece:
        """Return the episode's numbers."""
        self._rows[self._content.names.done][-1:] = [True]
        table = numbers_table(self._layout, {key: np.array(rows) for key, rows in self._rows.items()})
        for key, images in self._encoded.items():
            if images:
                table = table.append_column(key, image_column(images))
        for key, samples in self._samples.items():
            table = table.append_column(SAMPLE + key, sample_column(samples))
        histograms = {key: statistics.histogram.tolist() for key, statistics in self._statistics.items()}
        facts: dict[str, Any] = {
            "episode_id": episode.episode_id,
            "success": episode.success,
            "metadata": dict(episode.metadata),
        }
        if episode.robot != self._layout.robot_type:
            facts["robot"] = episode.robot
        return Piece(table=table, facts={"episode": facts, "histograms": histograms, "images": len(table)})
