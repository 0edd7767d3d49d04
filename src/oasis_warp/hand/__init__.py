"""The hand model: template, skinning, pose correctives, kinematics and named poses."""
