"""Sweeps of many trainings: the list (`plan`, `sources`), where they run (`local`, `cluster`), the loop (`run`)."""
