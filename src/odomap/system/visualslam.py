"""SLAM with cameras: tracking against a map that goes on being mapped, and the map as a result.

The tracker places every frame; each new keyframe is given to local mapping, which completes,
adjusts and thins the map around it, in a thread of its own unless the rhythm is "inline". Unlike
an odometry's, the map is kept: what was seen before is found again, and used. Where the path has
drifted too far for that, the closer recognises the place by its words, and corrects the path.

Reference: Mur-Artal, Montiel, Tardós, "ORB-SLAM: a versatile and accurate monocular SLAM system",
T-RO 2015; Mur-Artal, Tardós, "ORB-SLAM2", T-RO 2017.
"""

from collections.abc import Mapping
from dataclasses import replace

from odomap.errors import ConfigError
from odomap.files.vocabulary import Vocabulary
from odomap.maps.map import Map
from odomap.sensors.rig import Rig
from odomap.system.config import Config, make_association, preset, preset_for
from odomap.system.depthbias import DepthBias
from odomap.system.keyframetracking import KeyframeTracker
from odomap.system.keyframing import Keyframes
from odomap.system.localmapping import LocalMapper, MappingSections
from odomap.system.loopsearch import LoopSearch
from odomap.system.maptracking import MapTracker
from odomap.system.path import Path
from odomap.system.recognisedstart import RecognisedStart
from odomap.system.recognition import Recognizer
from odomap.system.stages import Adjuster, Closer, Stages
from odomap.system.starting import make_start
from odomap.system.visual import Sight, VisualSystem
from odomap.vision.vocabulary import VocabularyTree

__all__ = ["VisualSlam"]


class VisualSlam(VisualSystem):
    """Simultaneous localisation and mapping with the cameras of a rig; see `slam.Slam`."""

    def __init__(
        self,
        rig: Rig,
        config: Config | None = None,
        rhythm: str = "inline",
        map: Map | None = None,
        is_mapping: bool = True,
        vocabulary: VocabularyTree | None = None,
    ) -> None:
        config = preset(preset_for(rig)) if config is None else config
        self._is_mapping = is_mapping
        named = config.places.vocabulary or None
        self._words = Vocabulary.load(named) if vocabulary is None else vocabulary
        super().__init__(Sight.of(rig, config), config, rhythm, map)

    def _stages(self, sight: Sight, config: Config) -> Stages:
        eye, ranger = sight.eye, sight.ranger
        follows = config.tracking.association == "flow"
        if follows and not self._is_mapping:
            raise ConfigError(
                "tracking.association: optical flow follows keyframes, and none are made where the "
                "map is not to change: use 'features'"
            )
        if not follows:  # features are matched where the mapper looks for them, not followed
            config = replace(config, candidates=replace(config.candidates, follow=False))
        association = make_association(config, eye.mask)
        bias = sight.depth_bias(config.noise)
        keyframes = Keyframes(self.map, eye, ranger, bias, association, config)
        start = make_start(self.map, eye, keyframes, association, config)
        recognizer = Recognizer(
            self.map,
            eye.camera,
            eye.T_body_camera,
            config.matching,
            config.tracking.min_inliers,
            config.orb.scale,
            self._words,
        )
        if follows and self.map.num_keyframes:
            start = RecognisedStart(self.map, eye, keyframes, recognizer, config.orb)
        parts = self.map, eye, association, keyframes, start, config
        self._tracker: KeyframeTracker | MapTracker = (
            KeyframeTracker(*parts) if follows else MapTracker(*parts, recognizer, self._is_mapping)
        )
        depth = (1.0, 0.0) if ranger is None else (ranger.sigma, ranger.calibration)
        sections = _sections(config)
        self._mapper = LocalMapper(
            self.map, eye.camera, eye.T_body_camera, sections, bias, *depth, ranger is not None
        )
        if not self._is_mapping:
            return Stages(self.map, self._tracker)
        if not config.closing.enabled:
            return Stages(self.map, self._tracker, self._mapper)
        closer = self._closer(sight, sections, config)
        adjuster = (
            self._adjuster(sight, sections, config, bias) if config.adjusting.enabled else None
        )
        return Stages(self.map, self._tracker, self._mapper, closer, adjuster)

    def _closer(self, sight: Sight, sections: MappingSections, config: Config) -> Closer:
        from odomap.system.closing import LoopCloser, SideVerifier  # what compiles pose graphs

        eye, with_scale = sight.eye, sight.ranger is None
        verifier = SideVerifier(
            eye.camera,
            eye.T_body_camera,
            sections.sigma_px,
            sections.level_scale,
            with_scale,
            sections.matching,
        )
        search, forget = LoopSearch(self._words, config.closing), self._mapper.forget_drifts
        return LoopCloser(self.map, search, verifier, with_scale, config.closing, forget)

    def _adjuster(
        self, sight: Sight, sections: MappingSections, config: Config, bias: DepthBias
    ) -> Adjuster:
        from odomap.system.globaladjustment import GlobalAdjuster  # what compiles large bundles

        return GlobalAdjuster(
            self.map,
            sight.eye.camera,
            sight.eye.T_body_camera,
            sections.sigma_px,
            sections.level_scale,
            1.0 if sight.ranger is None else sight.ranger.sigma,
            bias,
            sections.mapping.gate,
            sections.bundle,
            config.adjusting,
            self._mapper.counts,
        )

    @property
    def _path(self) -> Path:
        return self._tracker.path

    def _come_to_rest(self) -> None:
        if isinstance(self._tracker, MapTracker):
            self._tracker.place_again()

    def _counts(self) -> Mapping[str, int]:
        return dict(self._mapper.counts)


def _sections(config: Config) -> MappingSections:
    noise = config.noise
    return MappingSections(
        config.mapping,
        config.local,
        config.creating,
        config.fusing,
        config.culling,
        config.matching,
        config.bundle,
        noise,
        noise.position_px if config.tracking.association == "flow" else noise.feature_px,
        config.orb.scale,
    )
