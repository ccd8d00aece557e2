"""What stands where no camera looked: a classifier of shape and intensity, trained on the labels of the images."""
