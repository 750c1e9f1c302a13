"""Detections to and from the supervision library, which reads what most detectors give. It comes as an extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from posekit.errors import OutputError, PromptError
from posekit.results import Detection, Source


def from_supervision(detections: Any, names: Mapping[int, str] | Sequence[str] | None = None) -> list[Detection]:
    """Detections from ``supervision.Detections``, in their order.

    detections: anything with ``xyxy`` (N, 4), edges in pixels, and, each of them or None, ``mask`` bool (N, H, W),
    ``confidence`` (N,) and ``class_id`` (N,), and ``data``; supervision itself is not needed. names: of the classes, by
    ``class_id``; ``data["class_name"]`` counts first. Without either, labels are None. Raises PromptError where the
    shapes do not fit.
    """
    boxes = np.asarray(getattr(detections, "xyxy", None), dtype=object)
    count = len(boxes) if boxes.ndim else -1
    if count < 0 or (count and boxes.shape != (count, 4)):
        raise PromptError("these are no detections: give supervision.Detections, or what has xyxy (N, 4) as they do.")
    mask, confidence, class_id = (_column(detections, key, count) for key in ("mask", "confidence", "class_id"))
    labels = (getattr(detections, "data", None) or {}).get("class_name")
    if labels is None and class_id is not None and names is not None:
        labels = [_name(names, int(number)) for number in class_id]
    if labels is not None and len(labels) != count:
        raise PromptError(f'data["class_name"] has {len(labels)} entries for {count} boxes: give one for each.')
    found = []
    for k in range(count):
        x0, y0, x1, y1 = (float(v) for v in boxes[k])
        found.append(
            Detection(
                box=(x0, y0, x1, y1),
                mask=_mask(mask, k),
                score=1.0 if confidence is None else float(confidence[k]),
                label=None if labels is None else str(labels[k]),
                source=Source.FILE,
            )
        )
    return found


def to_supervision(detections: Sequence[Detection]) -> Any:
    """``supervision.Detections`` of them, in their order.

    ``class_id`` numbers the labels in alphabetical order, from 0; ``data["class_name"]`` has the labels, "object" where
    there is none. ``mask`` is None where not all of them have one. Raises OutputError where supervision is not
    installed.
    """
    try:
        import supervision
    except ImportError as error:
        raise OutputError('this needs supervision: pip install "posekit[supervision]".') from error
    if not detections:
        return supervision.Detections.empty()
    labels = [each.label or "object" for each in detections]
    numbers = {label: k for k, label in enumerate(sorted(set(labels)))}
    masks = [each.mask for each in detections if each.mask is not None]
    return supervision.Detections(
        xyxy=np.array([each.box for each in detections], np.float32),
        mask=np.stack(masks) if len(masks) == len(detections) else None,
        confidence=np.array([each.score for each in detections], np.float32),
        class_id=np.array([numbers[label] for label in labels]),
        data={"class_name": np.array(labels)},
    )


def _column(detections: Any, key: str, count: int) -> Any:
    """An entry for each box, or None."""
    values = getattr(detections, key, None)
    if values is not None and len(values) != count:
        raise PromptError(f"{key} has {len(values)} entries for {count} boxes: give one for each, or None.")
    return values


def _name(names: Mapping[int, str] | Sequence[str], number: int) -> str:
    try:
        return names[number]
    except (KeyError, IndexError) as error:
        raise PromptError(f"class_id {number} has no name: names has {len(names)} of them.") from error


def _mask(masks: Any, k: int) -> Any:
    """The k-th mask, bool (H, W); None where it is empty, or there are none."""
    if masks is None:
        return None
    mask = np.asarray(masks[k], np.bool_)
    if mask.ndim != 2:
        raise PromptError(f"mask is bool (N, H, W), not {np.shape(masks)}.")
    return mask if mask.any() else None
