"""Objects in a selection: connected components, oriented boxes, and a catalogue for other programs."""

from normlift_ns.objects.parts import Objects, SceneObject, connected_components, find_objects

__all__ = ["Objects", "SceneObject", "connected_components", "find_objects"]
