"""The model cards of modern backbones and of canonical frames before any of them; literal data."""

from __future__ import annotations

from partialbench.registry import ModelCard, Recipe

POINTS = "pc (1024×3)"

_ANCHORS = (
    "sampling starts at the point farthest from the centroid and chooses none twice; the release "
    "starts at index 0, and there the order of a cloud's points moves its logits by 45–115 % of "
    "what clouds differ by (quirks=start)"
)
_ORIGIN = (
    "points near the origin are sampled as others; the release's kernel takes those with |p|² ≤ "
    "0.001 for padding (quirks=origin)"
)
_SHARES = (
    "of a cloud of fewer points than the published 1,024, the same shares are kept at each level; "
    "the release would sample points again"
)
_SMALL = _SHARES + ", and of very small clouds as many neighbours as there are"
_BEST_EPOCH = " The release keeps the best test epoch."

CARDS: tuple[ModelCard, ...] = (
    ModelCard(
        name="pointmlp-elite",
        entry="baselines.pointmlp:PointMLP",
        title="PointMLP (elite)",
        paper="Ma et al., Rethinking Network Design and Local Geometry in Point Cloud, ICLR 2022",
        reference="ma-xu/pointMLP-pytorch@1ab7f04",
        reference_licence="Apache-2.0",
        representation=POINTS,
        invariances=frozenset({"permutation"}),
        parameters={40: 716_232, 15: 709_807},
        recipe=Recipe(
            optimizer="sgd",
            lr=0.1,
            momentum=0.9,
            weight_decay=2e-4,
            batch_size=32,
            epochs=300,
            schedule="cosine",
            schedule_options={"final_lr": 0.005},
            label_smoothing=0.2,
            smoothing_over_others=True,
            clip_norm=1.0,
            notes=(
                "Published augmentation: scale per axis 2/3–3/2, shift 0.2, shuffle; no rotation."
                + _BEST_EPOCH
            ),
        ),
        published="baselines.pointmlp:from_published",
        published_options={"quirks": "start+origin"},
        choices=(
            "neighbourhoods are divided by the spread of their own cloud, as released since "
            "abc9176; before, and in the paper's figures, by that of the whole batch, with which "
            "a cloud's answer depended on its company",
            _SMALL,
        ),
        deviations=(_ANCHORS, _ORIGIN),
    ),
    ModelCard(
        name="pointnext-s",
        entry="baselines.pointnext:PointNeXt",
        title="PointNeXt-S",
        paper="Qian et al., PointNeXt, NeurIPS 2022",
        reference="guochengqian/PointNeXt@02341db; guochengqian/openpoints@8c115a9",
        reference_licence="MIT",
        representation=POINTS,
        invariances=frozenset({"permutation"}),
        parameters={40: 1_373_512, 15: 1_367_087},
        recipe=Recipe(
            optimizer="adamw",
            lr=1e-3,
            weight_decay=0.05,
            batch_size=32,
            epochs=600,
            schedule="cosine",
            schedule_options={"final_lr": 1e-6},
            label_smoothing=0.2,
            smoothing_over_others=True,
            clip_norm=1.0,
            notes=(
                "Published augmentation: scale per axis 2/3–3/2, shift 0.2; no rotation. Published "
                "weight decay spares biases and norms." + _BEST_EPOCH
            ),
        ),
        published="baselines.pointnext:from_published",
        published_options={"quirks": "start+order"},
        choices=(
            "the ModelNet40 form of 32 channels; three input channels: the height above the lowest "
            "point that the ScanObjectNN form adds means nothing in a camera's frame",
            "published radii, of clouds in the unit ball: of 256 points many balls of the first "
            "level hold few",
            _SHARES,
        ),
        deviations=(
            _ANCHORS,
            "balls keep their nearest points; the release keeps the first in index order "
            "(quirks=order)",
        ),
    ),
    ModelCard(
        name="pct",
        entry="baselines.pct:PCT",
        title="PCT",
        paper="Guo et al., PCT: Point Cloud Transformer, CVM 2021",
        reference="Strawberry-Eat-Mango/PCT_Pytorch@0199a3b (model.py)",
        reference_licence="MIT",
        representation=POINTS,
        invariances=frozenset({"permutation"}),
        parameters={40: 2_876_136, 15: 2_869_711},
        recipe=Recipe(
            optimizer="sgd",
            lr=0.01,
            momentum=0.9,
            weight_decay=5e-4,
            batch_size=32,
            epochs=250,
            schedule="cosine",
            schedule_options={"final_lr": 1e-4},
            label_smoothing=0.2,
            smoothing_over_others=True,
            notes=(
                "Published augmentation: point dropout up to 0.875, scale 0.8–1.25, shift 0.1."
                + _BEST_EPOCH
            ),
        ),
        published="baselines.pct:from_published",
        published_options={"quirks": "start+origin"},
        choices=(
            "the release's first model: attention sees no positions, queries and keys share their "
            "weights and are not scaled",
            _SMALL,
        ),
        deviations=(_ANCHORS, _ORIGIN),
    ),
)
