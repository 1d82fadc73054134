"""The model cards of the rotation-robust models since the paper. Literal data; loads no torch."""

from __future__ import annotations

from partialbench.registry import ModelCard

POINTS = "pc (1024×3)"

CARDS: tuple[ModelCard, ...] = (
    ModelCard(
        name="riconv2",
        entry="baselines.riconv2:RIConv2",
        title="RIConv++",
        paper="Zhang et al., RIConv++, IJCV 2022",
        reference="cszyzhang/riconv2@70d9297",
        reference_licence="MIT",
        representation=POINTS,
        invariances=frozenset({"permutation", "rotation"}),
        parameters={40: 423_656, 15: 420_431},
        published="baselines.riconv2:from_published",
        published_options={"quirks": "start+ring"},
    ),
    ModelCard(
        name="vn-pointnet",
        entry="baselines.vn_pointnet:VNPointNet",
        title="VN-PointNet",
        paper="Deng et al., Vector Neurons, ICCV 2021",
        reference="FlyingGiraffe/vnn@f3197e2",
        reference_licence="MIT",
        representation=POINTS,
        invariances=frozenset({"permutation", "rotation"}),
        parameters={40: 1_972_745, 15: 1_966_320},
        published="baselines.vn_pointnet:from_published",
    ),
    ModelCard(
        name="vn-dgcnn",
        entry="baselines.vn_dgcnn:VNDGCNN",
        title="VN-DGCNN",
        paper="Deng et al., Vector Neurons, ICCV 2021",
        reference="FlyingGiraffe/vnn@f3197e2",
        reference_licence="MIT",
        representation=POINTS,
        invariances=frozenset({"permutation", "rotation"}),
        parameters={40: 2_899_830, 15: 2_893_405},
        published="baselines.vn_dgcnn:from_published",
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
        invariances=frozenset({"permutation", "rotation"}),
        parameters={40: 1_880_001, 15: 1_873_576},
        published="baselines.local_to_global:from_published",
        published_options={"quirks": "layout+neighbours+signs+dropout"},
    ),
)
