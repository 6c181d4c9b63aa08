"""Videos of the game that are small and short."""

from __future__ import annotations

from sb3_torcs.rendering.encoder import PHOTOGRAPHIC, write_video
from sb3_torcs.rendering.game_video import GameVideo
from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.torcs.window import window_arguments
from sb3_torcs.tracks.trial import check_track

SIZE = (160, 120)
FPS = 5  # that the physics meets exactly: 100 of its steps
LAP = RaceSetup("a-speedway", [("inferno", 3)], laps=1)


def recorded(game, race=LAP, size=SIZE, **options):
    def start(window):
        return GameProcess(game, race, check=check_track, **window_arguments(game, window))

    return GameVideo(start, size=size, **{"fps": FPS, **options})


def saved(video, path):
    pictures = (frame.picture for frame in video.frames())
    return write_video(path, pictures, video.fps, encoding=PHOTOGRAPHIC)
