"""Many trainings: what they are (`plan`, `presets`), who runs them (`local`, `cluster`), and the loop (`run`)."""
