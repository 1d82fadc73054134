"""The model cards of modern backbones and of canonical frames before any of them; literal data."""

from __future__ import annotations

from partialbench.registry import ModelCard, Recipe

POINTS = "pc (1024×3)"

_ANCHORS = (
    "sampling starts at the point farthest from the centroid and chooses none twice; the release "
    "starts at index 0, and there the order of a cloud's points moves its logits by 45–115 % of "
    "what clouds differ by (quirks=start)"
)
_COPIES = (
    "where a cloud has fewer distinct points than are sampled (half of its points) copies are, "
    "and the order of the points says which: of 24 views of ModelNet40 shapes of 384 points the "
    "four with 111 to 191 distinct ones got, in another order, logits of random weights off by up "
    "to 0.21 of the largest; of the others one, at a tie"
)
_ORIGIN = (
    "points near the origin are sampled as others; the release's kernel takes those with |p|² ≤ "
    "0.001 for padding (quirks=origin)"
)
_SMALL = (
    "of a cloud of fewer points than the published 1,024, the same shares are kept at each level, "
    "and of very small clouds as many neighbours as there are; the release samples points again "
    "(quirks=counts)"
)
_BACKBONE = (
    "PointNet++ (SSG) by default, as the paper's own T-Net, IT-Net and RRI rows have; any model "
    'that predicts classes alone: backbone=dgcnn, backbone_options={"k": 10}'
)
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
        published_options={"quirks": "start+origin+counts"},
        choices=(
            "neighbourhoods are divided by the spread of their own cloud, as released since "
            "abc9176; before, and in the paper's figures, by that of the whole batch, with which "
            "a cloud's answer depended on its company",
            _SMALL,
            _COPIES,
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
                "Published augmentation: scale per axis 2/3–3/2, shift 0.2; no rotation."
                + _BEST_EPOCH
            ),
        ),
        published="baselines.pointnext:from_published",
        published_options={"quirks": "start+order"},
        choices=(
            "the ModelNet40 form of 32 channels; three input channels: the height above the lowest "
            "point that the ScanObjectNN form adds means nothing in a camera's frame",
            "published radii, of clouds in the unit ball: of 256 points many balls of the first "
            "level hold few",
            "half of the points are kept at each level, however many a cloud has, as released",
            _COPIES,
        ),
        deviations=(
            _ANCHORS,
            "balls keep their nearest points; the release keeps the first in index order "
            "(quirks=order)",
            "weight decay is of all parameters; the release spares biases and norms",
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
        published_options={"quirks": "start+origin+counts"},
        choices=(
            "the release's first model: attention sees no positions, queries and keys share their "
            "weights and are not scaled",
            _SMALL,
            _COPIES,
        ),
        deviations=(_ANCHORS, _ORIGIN),
    ),
    ModelCard(
        name="canonical-pca24",
        entry="baselines.canonical_pca24:CanonicalPCA24",
        title="24 axes, PN++",
        paper="Li et al., A Closer Look at Rotation-Invariant Deep Point Cloud Analysis, ICCV 2021",
        reference="feiran-l/rotation-invariant-pointcloud-analysis@205b6e9",
        reference_licence="MIT",
        representation=POINTS,
        invariances=frozenset({"rotation"}),
        parameters={40: 1_475_688, 15: 1_469_263},
        recipe=Recipe(
            optimizer="sgd",
            lr=0.1,
            momentum=0.9,
            weight_decay=1e-4,
            batch_size=32,
            epochs=4000,
            schedule="cosine",
            schedule_options={"final_lr": 1e-6},
            label_smoothing=0.2,
            smoothing_over_others=True,
            notes="Published without augmentation." + _BEST_EPOCH,
        ),
        published="baselines.canonical_pca24:from_published",
        published_options={"backbone": "released", "pooling": "blend"},
        choices=(
            _BACKBONE,
            "principal axes are those of the centred cloud, in double precision; the release does "
            "not centre",
            "in training one of the 24 poses, drawn at random, as the release draws an order of "
            "them; in evaluation all, which costs 24 passes",
            "where two of a cloud's variances are equal, axes are any in their plane, and no pose "
            "of the 24 mends that: a solid of revolution gets another answer when turned",
            "PointNet++ samples and groups in single precision: of 32 turned clouds of 256 to 600 "
            "points one got logits off by more than 10⁻⁴ of the largest, by 0.006",
        ),
        deviations=(
            "logits of all poses are averaged. The release blends the 24 clouds into one: their "
            "weighted sum is the cloud times a general 3×3 matrix, of singular values 0.71, 0.50 "
            "and 0.40 on average before training; flat weights shrink it to a point "
            "(pooling=blend, with which the logits of all 24 orders are summed)",
            "PointNet++ in place of DGCNN with a T-Net and 25 neighbours (backbone=released: "
            "2,904,777 parameters with pooling=blend; the release has 3,072 more that it never "
            "uses). Its neighbours among features flip by rounding: a turn moves its sums of "
            "logits by 0.001–0.16",
        ),
    ),
    ModelCard(
        name="canonical-vn",
        entry="baselines.canonical_vn:CanonicalVN",
        title="Learned frame, PN++",
        paper="Mondal et al., Equivariant Adaptation of Large Pretrained Models, NeurIPS 2023",
        reference="arnab39/equiadapt@657ee6f",
        reference_licence="MIT",
        representation=POINTS,
        invariances=frozenset({"rotation"}),
        parameters={40: 1_476_998, 15: 1_470_573},
        recipe=Recipe(
            optimizer="sgd",
            lr=0.1,
            momentum=0.9,
            weight_decay=1e-4,
            batch_size=64,
            epochs=250,
            schedule="cosine",
            schedule_options={"final_lr": 0.001},
            notes=(
                "Published augmentation: scale per axis, shift, then a rotation about z. Stops "
                "early on test accuracy."
            ),
        ),
        published="baselines.canonical_vn:from_published",
        published_options={
            "backbone": "released",
            "prior": 100.0,
            "quirks": "mirror+epsilon+dropout",
        },
        choices=(
            _BACKBONE,
            "the class loss alone trains the frame. The published prior draws it to the identity, "
            "which needs training clouds near one pose; of clouds turned at random, as here, it is "
            "2/3 on average whatever the frame, and its gradient noise (prior=100)",
            "the frame is of double precision in evaluation: its layers divide by lengths and "
            "amplify rounding",
            "the frame's fourth vector, and its third but for quirks=mirror, are not used; their "
            "weights stay, for the published count of 1,310",
        ),
        deviations=(
            "two vectors and the one across them make the frame; the release's third vector "
            "mirrors 11–20 of 32 clouds at random weights (quirks=mirror)",
            "nothing is dropped from the frame; the release drops components of vectors, after "
            "which they do not turn with the cloud: its canonical points move by 1.5–1.8 in "
            "training (quirks=dropout)",
            "vectors shorter than 0.3 fade (ε, published 10⁻⁶): else one near zero points where "
            "rounding says, and at random weights 35 % of 96 turned clouds got logits off by more "
            "than 10⁻⁴ of the largest, by up to 0.014; so none, by up to 6·10⁻⁵ (quirks=epsilon). "
            "Of 104 views of ModelNet40 shapes two did, by up to 0.0013",
            "clouds are centred inside the model: a shift of 0.1 moves the release's logits by 1.4 "
            "times what clouds differ by",
            "PointNet++ in place of a PointNet without T-Nets (backbone=released, 697,478 "
            "parameters) or DGCNN (backbone=dgcnn, 1,810,886)",
        ),
    ),
)
