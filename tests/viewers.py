"""Somebody who sits before a display on which the game shows a race."""

from __future__ import annotations

import ctypes
import time

import numpy as np

from sb3_torcs.torcs.process import GameProcess
from sb3_torcs.torcs.race_setup import RaceSetup
from sb3_torcs.torcs.window import Window, window_arguments
from sb3_torcs.tracks.trial import check_track

SIZE = (320, 240)
LAP = RaceSetup("aalborg", [("inferno", 3)], laps=1)
ESCAPE = 9  # the key's code
KEY_PRESS, KEY_PRESS_MASK, FULL_PICTURE = 2, 1, 2
CLIENT_MESSAGE = 33


def shown(game, display, race=LAP, **options):
    window = Window(SIZE, display=display.name, **options)
    return GameProcess(game, race, check=check_track, **window_arguments(game, window))


class XKeyEvent(ctypes.Structure):
    """As Xlib lays it out."""

    _fields_ = [
        ("type", ctypes.c_int), ("serial", ctypes.c_ulong), ("send_event", ctypes.c_int),
        ("display", ctypes.c_void_p), ("window", ctypes.c_ulong), ("root", ctypes.c_ulong),
        ("subwindow", ctypes.c_ulong), ("time", ctypes.c_ulong), ("x", ctypes.c_int),
        ("y", ctypes.c_int), ("x_root", ctypes.c_int), ("y_root", ctypes.c_int),
        ("state", ctypes.c_uint), ("keycode", ctypes.c_uint), ("same_screen", ctypes.c_int),
        ("rest_of_an_event", ctypes.c_long * 24),
    ]  # fmt: skip


class XClientMessageEvent(ctypes.Structure):
    """As Xlib lays it out."""

    _fields_ = [
        ("type", ctypes.c_int), ("serial", ctypes.c_ulong), ("send_event", ctypes.c_int),
        ("display", ctypes.c_void_p), ("window", ctypes.c_ulong), ("message_type", ctypes.c_ulong),
        ("format", ctypes.c_int), ("data", ctypes.c_long * 5),
        ("rest_of_an_event", ctypes.c_long * 24),
    ]  # fmt: skip


class XImage(ctypes.Structure):
    """The beginning of what Xlib returns."""

    _fields_ = [
        ("width", ctypes.c_int), ("height", ctypes.c_int), ("xoffset", ctypes.c_int),
        ("format", ctypes.c_int), ("data", ctypes.c_void_p),
    ]  # fmt: skip


class Viewer:
    """Somebody who sits before a display."""

    def __init__(self, name):
        self.x = ctypes.CDLL("libX11.so.6")
        for function in ("XOpenDisplay", "XDefaultRootWindow"):
            getattr(self.x, function).restype = ctypes.c_void_p
        self.x.XGetImage.restype = ctypes.POINTER(XImage)
        self.display = ctypes.c_void_p(self.x.XOpenDisplay(name.encode()))
        self.root = ctypes.c_ulong(self.x.XDefaultRootWindow(self.display))

    def look(self):
        """Take a picture, (height, width, 3)."""
        every_plane = ctypes.c_ulong(2**32 - 1)
        image = self.x.XGetImage(
            self.display, self.root, 0, 0, *SIZE, every_plane, FULL_PICTURE
        ).contents
        data = ctypes.string_at(image.data, SIZE[0] * SIZE[1] * 4)
        return np.frombuffer(data, np.uint8).reshape(SIZE[1], SIZE[0], 4)[..., :3].astype(int)

    def wait_for_a_race(self):
        """Wait for a picture with the sky above the road."""
        for _ in range(12_000):
            picture = self.look()
            if picture[:60].mean() > 120 > picture[-60:].mean() > 30:
                return picture
            time.sleep(0.05)
        raise AssertionError("there is no race to be seen")

    def window(self):
        """The only one there is."""
        window, children = ctypes.c_ulong(), ctypes.POINTER(ctypes.c_ulong)()
        number = ctypes.c_uint()
        self.x.XQueryTree(
            self.display, self.root, ctypes.byref(window), ctypes.byref(window),
            ctypes.byref(children), ctypes.byref(number),
        )  # fmt: skip
        return ctypes.c_ulong(children[number.value - 1])

    def press(self, code):
        """Press a key."""
        target = self.window()
        event = XKeyEvent(
            type=KEY_PRESS, window=target.value, root=self.root.value, keycode=code, same_screen=1
        )
        self.x.XSendEvent(self.display, target, 1, KEY_PRESS_MASK, ctypes.byref(event))
        self.x.XSync(self.display, 0)

    def close_window(self):
        """Click where a window manager shows a cross."""
        window = self.window()
        message = XClientMessageEvent(type=CLIENT_MESSAGE, window=window.value, format=32)
        message.message_type = self.x.XInternAtom(self.display, b"WM_PROTOCOLS", 0)
        message.data[0] = self.x.XInternAtom(self.display, b"WM_DELETE_WINDOW", 0)
        self.x.XSendEvent(self.display, window, 0, 0, ctypes.byref(message))
        self.x.XSync(self.display, 0)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.x.XCloseDisplay(self.display)
