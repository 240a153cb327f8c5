"""Sweeps of many trainings: the list (`plan`, `sources`), where they run (`places`), the loop (`run`)."""
