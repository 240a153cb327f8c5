"""Sweeps of many trainings: the list (`plan`, `presets`), where they run (`local`, `cluster`), the loop (`run`)."""
