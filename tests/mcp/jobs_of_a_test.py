"""Jobs for the tests of the worker, in a process of its own."""

import os
import time

from dolens.errors import InputError


def sleep(seconds):
    time.sleep(seconds)
    return "awake"


def refuse():
    raise InputError("no\nsuch thing")


def fail():
    raise KeyError("secret")


def end():
    os._exit(3)


def say():
    os.write(1, b"in the way of the protocol\n")
    return os.getpid()


JOBS = {job.__name__: job for job in (sleep, refuse, fail, end, say)}
