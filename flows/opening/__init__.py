"""Opening of what a survey looks at: scene, rig or recording, weights, zones and prior map."""
