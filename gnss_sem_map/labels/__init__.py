"""Class sets, class probabilities, and the confusion model of the segmentation network."""
