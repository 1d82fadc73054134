"""The model cards of rotation-robust models since the paper. Literal data; loads no torch."""

from __future__ import annotations

from partialbench.registry import ModelCard, Recipe

POINTS = "pc (1024×3)"
_INVARIANT = frozenset({"permutation", "rotation"})

_STAIRS = {"gamma": 0.7, "every_epochs": 20}
_YANX27 = (
    "Published augmentation: point dropout up to 0.875, scale 0.8–1.25, shift 0.1 after centring. "
    "The release keeps the best test epoch."
)

_RICONV2_RECIPE = Recipe(
    optimizer="adam",
    lr=1e-3,
    weight_decay=1e-4,
    batch_size=16,
    epochs=300,
    schedule="step",
    schedule_options=_STAIRS,
    notes=_YANX27 + " No script of it rotates anything.",
)
_LOCAL_TO_GLOBAL_RECIPE = Recipe(
    optimizer="sgd",
    lr=0.1,
    momentum=0.9,
    weight_decay=1e-4,
    batch_size=32,
    epochs=300,
    schedule="cosine",
    schedule_options={"final_lr": 0.001},
    label_smoothing=0.2,
    smoothing_over_others=True,
    notes=(
        "Published augmentation: scale per axis 2/3–3/2, shift 0.2. Reported after running "
        "several times to obtain the best."
    ),
)
_RICONV2_CHOICES = (
    "as many centres as on ModelNet40: all points up to 1,024, then a half, a quarter, an eighth; "
    "of small clouds as many neighbours as there are (centres=512: the release's ScanObjectNN "
    "form)",
    "angles have no sign, as released; the paper signs them, but the line that would do so acts on "
    "booleans. Signs jump where two normals lean alike (signed_angles=true)",
    "the last level sees its points from the cloud's centroid but sorts them round their own, as "
    "released",
    "geometry is computed in double precision. Where two neighbours are as far or at one angle to "
    "seven digits, the turned coordinates' own rounding still chooses: of 192 turned clouds of 256 "
    "to 600 points one got logits off by more than 10⁻⁴ of the largest, by 0.017",
)
_RICONV2_DEVIATIONS = (
    "sampling starts at the point farthest from the centroid; the release's starts at index 0 and "
    "its answer depends on the order of the points (quirks=start)",
    "the ring's start is on its own left; the release leaves its side to rounding, which moves the "
    "log-probabilities of turned clouds by 0.35–0.76, of 3.0–3.8 between clouds (quirks=signs)",
    "the last level's axis is turned so that Σ(x·axis)³ ≥ 0; the release leaves its sign to "
    "LAPACK, a flip moves them by 1.6–2.6 (quirks=signs)",
    "the last level's first point is where it is on the ring; the release puts it on the left, "
    "wrongly half the time (quirks=ring)",
    "points as far as others or at one angle, of which coordinates of few digits make many, are "
    "told apart by their distance from the centroid, and a flat cloud's sides by the sense of "
    "three far points; the release leaves both to rounding, which reorders a sixth of the "
    "neighbourhoods of ModelNet40's clouds when they are turned (quirks=ties)",
    "cross products are of coordinates; the release's are along the first axis of size 3, so that "
    "a batch of exactly three clouds gets other answers, by 2.2–2.7 (quirks=cross)",
)

_VN_RECIPE = Recipe(
    optimizer="sgd",
    lr=0.1,
    momentum=0.9,
    weight_decay=1e-4,
    batch_size=32,
    epochs=250,
    schedule="step",
    schedule_options=_STAIRS,
    notes=_YANX27 + " Rotation none, about z or any.",
)
_VN_CHOICES = (
    "mean pooling over neighbours, the release's default",
    "the first layers are of double precision in evaluation: each divides by lengths and amplifies "
    "rounding",
)
_VN_CENTRED = (
    "clouds are centred inside the model: the release is not invariant to a shift, one of 0.1 "
    "moves its answers by 1–20 times what clouds differ by, and its augmentation shifts"
)

CARDS: tuple[ModelCard, ...] = (
    ModelCard(
        name="riconv2",
        entry="baselines.riconv2:RIConv2",
        title="RIConv++",
        paper="Zhang et al., RIConv++, IJCV 2022",
        reference="cszyzhang/riconv2@70d9297",
        reference_licence="MIT",
        representation=POINTS,
        invariances=_INVARIANT,
        parameters={40: 423_656, 15: 420_431},
        recipe=_RICONV2_RECIPE,
        published="baselines.riconv2:from_published",
        published_options={"quirks": "start+ring+ties"},
        choices=(
            "local reference axes of 32 neighbours in place of normals, as on ScanObjectNN (the "
            "author advises 64 elsewhere: lra_neighbours=64)",
            *_RICONV2_CHOICES,
        ),
        deviations=(
            "local reference axes point away from the centroid; the release leaves their signs to "
            "LAPACK: of a turned cloud 46 % stay, and its log-probabilities move by 2.2–2.7 "
            "(quirks=signs). orient=camera turns them to the camera by its ray, as the normals of "
            "what a camera sees are; then a cloud may be turned about the camera alone",
            *_RICONV2_DEVIATIONS,
        ),
    ),
    ModelCard(
        name="riconv2-normals",
        entry="baselines.riconv2:with_normals",
        title="RIConv++, with normals",
        paper="Zhang et al., RIConv++, IJCV 2022",
        reference="cszyzhang/riconv2@70d9297",
        reference_licence="MIT",
        representation="xyz + normals (1024×6)",
        inputs=("normals",),
        invariances=_INVARIANT,
        parameters={40: 423_656, 15: 420_431},
        recipe=_RICONV2_RECIPE,
        published="baselines.riconv2:from_published",
        published_options={"quirks": "start+ring+ties"},
        choices=(
            "the data's normals, as the release has on ModelNet40 those of the meshes",
            *_RICONV2_CHOICES,
        ),
        deviations=_RICONV2_DEVIATIONS,
    ),
    ModelCard(
        name="vn-pointnet",
        entry="baselines.vn_pointnet:VNPointNet",
        title="VN-PointNet",
        paper="Deng et al., Vector Neurons, ICCV 2021",
        reference="FlyingGiraffe/vnn@f3197e2",
        reference_licence="MIT",
        representation=POINTS,
        invariances=_INVARIANT,
        parameters={40: 1_972_745, 15: 1_966_320},
        recipe=_VN_RECIPE,
        published="baselines.vn_pointnet:from_published",
        choices=(
            *_VN_CHOICES,
            "what is left is the rounding of the turned coordinates themselves, grown in the "
            "directions of short vectors, which the published ε of 10⁻⁶ hardly fades: of 192 "
            "turned clouds of 256 to 600 points one got logits off by more than 10⁻⁴ of the "
            "largest, by 1.3·10⁻⁴",
        ),
        deviations=(_VN_CENTRED,),
    ),
    ModelCard(
        name="vn-dgcnn",
        entry="baselines.vn_dgcnn:VNDGCNN",
        title="VN-DGCNN",
        paper="Deng et al., Vector Neurons, ICCV 2021",
        reference="FlyingGiraffe/vnn@f3197e2",
        reference_licence="MIT",
        representation=POINTS,
        invariances=_INVARIANT,
        parameters={40: 2_899_830, 15: 2_893_405},
        recipe=Recipe(
            optimizer="sgd",
            lr=0.1,
            momentum=0.9,
            weight_decay=1e-4,
            batch_size=32,
            epochs=250,
            schedule="step",
            schedule_options=_STAIRS,
            label_smoothing=0.2,
            smoothing_over_others=True,
            notes=_VN_RECIPE.notes,
        ),
        published="baselines.vn_dgcnn:from_published",
        choices=(
            *_VN_CHOICES,
            "a shape and its mirror image get one answer, as published: nothing in it tells them "
            "apart",
        ),
        deviations=(_VN_CENTRED,),
    ),
    ModelCard(
        name="pari-conv",
        entry="baselines.pari_conv:PaRIConv",
        title="PaRI-Conv",
        paper="Chen & Cong, The Devil is in the Pose: Ambiguity-free 3D Rotation-invariant "
        "Learning via Pose-aware Convolution, CVPR 2022",
        reference="",
        reference_licence="",
        representation=POINTS,
        invariances=_INVARIANT,
        parameters={40: 1_842_280, 15: 1_835_855},
        recipe=_LOCAL_TO_GLOBAL_RECIPE,
        choices=(
            "its repository has no licence: written from the paper and from what local-to-global's "
            "source takes over of it, without that one's global branch and gates; the recipe is "
            "that one's too",
            "a point enters as its distance from the centroid and the cosine and sine of its axis "
            "against the direction to it",
            "local reference axes of 32 neighbours in place of normals, pointing away from the "
            "centroid; orient=camera turns them to the camera by its ray",
            "the layers are of double precision in evaluation, since they choose neighbours among "
            "features. Where two neighbours are as far to seven digits, the input's own rounding "
            "still chooses: of 192 turned clouds of 256 to 600 points four got logits off by more "
            "than 10⁻⁴ of the largest, by up to 0.02",
        ),
    ),
    ModelCard(
        name="local-to-global",
        entry="baselines.local_to_global:LocalToGlobal",
        title="Local-to-global",
        paper="Zhao et al., Rotation Invariant Point Cloud Analysis: Where Local Geometry Meets "
        "Global Topology, Pattern Recognition 2022",
        reference="CentauriStar/Rotation-Invariant-Point-Cloud-Analysis@a1b3fad",
        reference_licence="MIT",
        representation=POINTS,
        invariances=_INVARIANT,
        parameters={40: 1_880_001, 15: 1_873_576},
        recipe=_LOCAL_TO_GLOBAL_RECIPE,
        published="baselines.local_to_global:from_published",
        published_options={"quirks": "layout+neighbours+signs+dropout"},
        choices=(
            "its local layers are those of PaRI-Conv, whose own repository has no licence: written "
            "from the facts of this one",
            "local reference axes of 32 neighbours in place of normals, pointing away from the "
            "centroid; orient=camera turns them to the camera by its ray",
            "the layers that choose neighbours among features are of double precision in "
            "evaluation. Where two neighbours are as far to seven digits, the input's own rounding "
            "still chooses: of 192 turned clouds of 256 to 600 points four got logits off by more "
            "than 10⁻⁴ of the largest, by up to 0.018",
            "a point enters with the cosine and sine of its local axis; the release's ModelNet40 "
            "form without normals takes the direction from the centroid in its place",
        ),
        deviations=(
            "the global branch reads points; the release reads their N×3 numbers as 3×N, so that a "
            "rotation moves its logits by 60–85 % of what clouds differ by, the order of the "
            "points by 55 % (quirks=layout)",
            "both branches' edges lead to one neighbour; the release joins the j-th nearest of one "
            "space to the j-th of another (quirks=neighbours)",
            "axes have signs; the release leaves them to LAPACK (quirks=signs)",
            "dropout 0.5; the script's --dp 0.8 is taken for --dropout (quirks=dropout)",
        ),
    ),
)
