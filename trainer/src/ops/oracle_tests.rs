//! Every fused op: the composite's values and gradients, the slopes of finite differences, and the same bits twice.

use candle_core::{DType, Device, Result, Tensor, Var};
use proptest::prelude::*;

use super::check::{agree, random, slopes_agree, uniform};
use super::*;

fn one(x: Result<Tensor>) -> Result<Vec<Tensor>> {
    Ok(vec![x?])
}

#[test]
fn layer_norm_and_silu_equal_their_composites() {
    for (rows, width) in
        [(1, 1), (3, 5), (7, 8), (4, 12), (5, 16), (33, 4), (16, 8), (35, 32), (2, 48), (2, 255), (700, 128)]
    {
        let inputs = [random(&[rows, width], 1), random(&[width], 2), random(&[width], 3)];
        for eps in [1e-3, 1e-5] {
            // With one column everything is its own mean: values agree, gradients are rounding.
            let eps = if width == 1 { 1.0 } else { eps };
            agree(
                &inputs,
                |x| one(layer_norm(&x[0], &x[1], &x[2], eps)),
                |x| one(composite::layer_norm(&x[0], &x[1], &x[2], eps)),
            );
            agree(
                &inputs,
                |x| one(layer_norm_silu(&x[0], &x[1], &x[2], eps)),
                |x| one(composite::layer_norm_silu(&x[0], &x[1], &x[2], eps)),
            );
        }
        if rows * width < 200 {
            slopes_agree(&inputs, |x| one(layer_norm_silu(&x[0], &x[1], &x[2], 0.1)));
        }
    }
}

#[test]
fn linear_equals_its_composite_on_whole_and_sliced_weights() {
    for (lead, width, out) in
        [(vec![1], 1, 1), (vec![3, 2], 5, 7), (vec![2, 3, 4], 16, 8), (vec![512], 96, 130)]
    {
        let x = random(&[lead.as_slice(), &[width]].concat(), 1);
        let inputs = [x, random(&[out, width], 2), random(&[out], 3)];
        agree(
            &inputs,
            |x| one(linear(&x[0], &x[1], Some(&x[2]))),
            |x| one(composite::linear(&x[0], &x[1], Some(&x[2]))),
        );
        agree(
            &inputs[..2],
            |x| one(linear(&x[0], &x[1], None)),
            |x| one(composite::linear(&x[0], &x[1], None)),
        );
        let wide = [inputs[0].clone(), random(&[out, width + 6], 4)];
        let slice = |x: &Tensor| x.narrow(1, 4, width);
        agree(
            &wide,
            |x| one(linear(&x[0], &slice(&x[1])?, None)),
            |x| one(composite::linear(&x[0], &slice(&x[1])?, None)),
        );
        if out < 100 {
            slopes_agree(&inputs, |x| one(linear(&x[0], &x[1], Some(&x[2]))));
        }
    }
}

#[test]
fn the_recurrent_cell_equals_its_composite() {
    for (rows, d) in [(1, 1), (3, 5), (4, 16), (300, 64)] {
        let inputs =
            [random(&[rows, 3 * d], 1), random(&[3 * d], 2), random(&[3 * d], 3), random(&[rows, d], 4)];
        agree(
            &[inputs[0].clone(), inputs[3].clone()],
            |x| one(recurrent_update(&x[0], &x[1])),
            |x| one(composite::recurrent_update(&x[0], &x[1])),
        );
        let oracle = |x: &[Tensor]| {
            one(composite::recurrent_update(&composite::layer_norm(&x[0], &x[1], &x[2], 1e-3)?, &x[3]))
        };
        agree(&inputs, |x| one(recurrent_cell(&x[0], &x[1], &x[2], 1e-3, &x[3])), oracle);
        if rows < 100 {
            slopes_agree(&inputs, |x| one(recurrent_cell(&x[0], &x[1], &x[2], 1e-1, &x[3])));
        }
    }
}

#[test]
fn cross_attention_equals_its_composite() {
    for (batch, n, r, m) in [(1, 1, 1, 1), (2, 3, 5, 4), (3, 4, 6, 7), (2, 16, 24, 16), (2, 32, 40, 32)] {
        let inputs = [random(&[batch, n, m], 1), random(&[batch, r, m], 2), random(&[batch, r, m], 3)];
        let pair = |(mixture, attention)| vec![mixture, attention];
        agree(
            &inputs,
            |x| cross_attention(&x[0], &x[1], &x[2]).map(pair),
            |x| composite::cross_attention(&x[0], &x[1], &x[2]).map(pair),
        );
        slopes_agree(&inputs, |x| cross_attention(&x[0], &x[1], &x[2]).map(pair));
    }
}

#[test]
fn categorical_ops_equal_their_composites() {
    for (lead, m) in [(vec![1], 2), (vec![2, 3], 5), (vec![4, 16], 16), (vec![40, 32], 32), (vec![300], 255)]
    {
        let shape = [lead.as_slice(), &[m]].concat();
        let inputs = [uniform(&shape, 1, -4.0, 4.0)];
        let gumbel = random(&shape, 2);
        for unimix in [0.0, 0.01] {
            agree(&inputs, |x| one(probs(&x[0], unimix)), |x| one(composite::probs(&x[0], unimix)));
            agree(&inputs, |x| one(log_probs(&x[0], unimix)), |x| one(composite::log_probs(&x[0], unimix)));
            agree(&inputs, |x| one(entropy(&x[0], unimix)), |x| one(composite::entropy(&x[0], unimix)));
            slopes_agree(&inputs, |x| one(log_probs(&x[0], unimix)));
            slopes_agree(&inputs, |x| one(entropy(&x[0], unimix)));
            for noise in [None, Some(&gumbel)] {
                agree(
                    &inputs,
                    |x| one(straight_through_sample(&x[0], unimix, noise)),
                    |x| one(composite::straight_through_sample(&x[0], unimix, noise)),
                );
            }
            agree(
                &inputs,
                |x| one(straight_through_mode(&x[0], unimix)),
                |x| one(composite::straight_through_mode(&x[0], unimix)),
            );
        }
        agree(&inputs, |x| one(softmax(&x[0])), |x| one(composite::softmax(&x[0])));
        agree(&inputs, |x| one(sigmoid(&x[0])), |x| one(composite::sigmoid(&x[0])));
    }
}

#[test]
fn the_balanced_divergence_equals_its_composite_above_and_below_the_free_nats() {
    for (lead, n, m) in [(vec![3], 1, 2), (vec![2, 5], 4, 6), (vec![40], 16, 16)] {
        let shape = [lead.as_slice(), &[n, m]].concat();
        let inputs = [random(&shape, 1), random(&shape, 2)];
        let mut balance = KlBalance { free: 1.0, prior_scale: 0.5, posterior_scale: 0.1 };
        for free in [0.0, 1.0, 1e3] {
            balance.free = free;
            let pair = |(loss, kl)| vec![loss, kl];
            agree(
                &inputs,
                |x| balanced_kl(&x[0], &x[1], 0.01, balance).map(pair),
                |x| composite::balanced_kl(&x[0], &x[1], 0.01, balance).map(pair),
            );
        }
        let (q, p) = (&inputs[0], &inputs[1]);
        let only = |prior_scale, posterior_scale| KlBalance { free: 0.0, prior_scale, posterior_scale };
        slopes_agree(
            &inputs[1..],
            |x| one(balanced_kl(q, &x[0], 0.01, only(1.0, 0.0)).map(|(loss, _)| loss)),
        );
        slopes_agree(
            &inputs[..1],
            |x| one(balanced_kl(&x[0], p, 0.01, only(0.0, 1.0)).map(|(loss, _)| loss)),
        );
    }
}

#[test]
fn two_hot_ops_equal_their_composites() {
    for (rows, count) in [(1, 3), (7, 31), (200, 255)] {
        let inputs = [random(&[rows, count], 1)];
        let bins = bins_tensor(count, &Device::Cpu).unwrap();
        let targets = uniform(&[rows], 3, -25.0, 25.0);
        agree(
            &inputs,
            |x| one(two_hot_mean(&x[0], &bins)?.tanh()),
            |x| one(composite::two_hot_mean(&x[0], &bins)?.tanh()),
        );
        agree(
            &inputs,
            |x| one(two_hot_loss(&x[0], &bins, &targets)),
            |x| one(composite::two_hot_loss(&x[0], &bins, &targets)),
        );
        slopes_agree(&inputs, |x| one(two_hot_loss(&x[0], &bins, &targets)));
    }
}

#[test]
fn a_target_on_a_bin_belongs_to_that_bin_alone() {
    let bins = bins_tensor(5, &Device::Cpu).unwrap(); // -20, -10, 0, 10, 20
    let logits = Tensor::new(&[[0f32, 0.0, 0.0, 0.0, 3.0]; 3], &Device::Cpu).unwrap();
    let targets = Tensor::new(&[20f32, 0.0, 99.0], &Device::Cpu).unwrap();
    let loss = two_hot_loss(&logits, &bins, &targets).unwrap().to_vec1::<f32>().unwrap();
    let sum = (4.0 + 3f32.exp()).ln();
    for (found, expected) in loss.iter().zip([sum - 3.0, sum, sum - 3.0]) {
        assert!((found - expected).abs() < 1e-6, "{loss:?}");
    }
}

#[test]
fn pictures_equal_their_composites() {
    let (n, side) = (3, 6);
    let bytes: Vec<u8> = (0..n * side * side * 3).map(|i| (i * 37 % 256) as u8).collect();
    let image = Tensor::from_vec(bytes, (n, side, side, 3), &Device::Cpu).unwrap();
    assert_eq!(
        image_to_float(&image).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap(),
        composite::image_to_float(&image).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
    );
    let mask = uniform(&[n, side, side], 5, 0.0, 1.0).ge(0.5).unwrap().to_dtype(DType::U8).unwrap();
    let inputs = [random(&[n, side, side, 4], 1), random(&[n, side, side, 4], 2)];
    for branches in 1..=2 {
        for mask in [None, Some(&mask)] {
            let all = |(loss, mask_loss): (Tensor, Option<Tensor>)| {
                [vec![loss], mask_loss.into_iter().collect()].concat()
            };
            agree(
                &inputs[..branches],
                |x| picture_loss(&x.iter().collect::<Vec<_>>(), &image, mask).map(all),
                |x| composite::picture_loss(&x.iter().collect::<Vec<_>>(), &image, mask).map(all),
            );
            slopes_agree(&inputs[..branches], |x| {
                picture_loss(&x.iter().collect::<Vec<_>>(), &image, mask).map(all)
            });
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn convolutions_equal_their_composites(
        batch in 1usize..5, height in 1usize..5, width in 1usize..7, inputs in 1usize..20, outputs in 1usize..36,
    ) {
        let x = random(&[batch, 2 * height, 2 * width, inputs], 1);
        let weight = random(&[outputs, inputs, 4, 4], 2);
        agree(&[x, weight], |x| one(conv_down(&x[0], &x[1])), |x| one(composite::conv_down(&x[0], &x[1])));
        let x = random(&[batch, height, width, inputs], 3);
        let weight = random(&[inputs, outputs, 4, 4], 4);
        agree(&[x, weight], |x| one(conv_up(&x[0], &x[1])), |x| one(composite::conv_up(&x[0], &x[1])));
    }
}

/// Inputs of a stack of three layers: x, then weight, gain and shift of each, the last with a bias instead of a norm if asked for.
fn stack_inputs(down: bool, batch: usize, side: usize, channels: [usize; 4], bias: bool) -> Vec<Tensor> {
    let mut inputs = vec![random(&[batch, side, side, channels[0]], 1)];
    for (i, step) in channels.windows(2).enumerate() {
        let weight = if down { [step[1], step[0], 4, 4] } else { [step[0], step[1], 4, 4] };
        let seed = 10 * i as u64;
        inputs.push(uniform(&weight, seed + 2, -0.3, 0.3));
        inputs.push(random(&[step[1]], seed + 3));
        if !(bias && i == 2) {
            inputs.push(random(&[step[1]], seed + 4));
        }
    }
    inputs
}

fn stack_layers(x: &[Tensor]) -> Vec<ConvLayer<'_>> {
    x[1..]
        .chunks(3)
        .map(|layer| match layer {
            [weight, gain, shift] => ConvLayer { weight, norm: Some((gain, shift, 1e-3)), bias: None },
            [weight, bias] => ConvLayer { weight, norm: None, bias: Some(bias) },
            _ => unreachable!(),
        })
        .collect()
}

#[test]
fn stacks_of_convolutions_equal_layer_after_layer() {
    for (batch, channels) in [(1, [3, 7, 5, 4]), (5, [3, 8, 16, 4])] {
        for bias in [false, true] {
            let finish = |layer: &ConvLayer<'_>, y: Result<Tensor>| match (layer.norm, layer.bias) {
                (Some((gain, shift, eps)), _) => composite::layer_norm_silu(&y?, gain, shift, eps),
                (_, Some(bias)) => y?.broadcast_add(bias),
                _ => y,
            };
            agree(
                &stack_inputs(true, batch, 16, channels, bias),
                |x| one(conv_down_stack(&x[0], &stack_layers(x))),
                |x| {
                    one(stack_layers(x).iter().try_fold(x[0].clone(), |y, layer| {
                        finish(layer, composite::conv_down(&y, layer.weight))
                    }))
                },
            );
            agree(
                &stack_inputs(false, batch, 2, channels, bias),
                |x| one(conv_up_stack(&x[0], &stack_layers(x))),
                |x| {
                    one(stack_layers(x).iter().try_fold(x[0].clone(), |y, layer| {
                        finish(layer, composite::conv_up(&y, layer.weight))
                    }))
                },
            );
        }
    }
    let small = stack_inputs(false, 1, 1, [2, 7, 8, 4], true);
    slopes_agree(&small, |x| one(conv_up_stack(&x[0], &stack_layers(x))));
}

#[test]
fn the_reconstruction_loss_is_that_of_the_decoded_pictures() {
    let bytes: Vec<u8> = (0..2 * 16 * 16 * 3).map(|i| (i * 91 % 256) as u8).collect();
    let image = Tensor::from_vec(bytes, (2, 16, 16, 3), &Device::Cpu).unwrap();
    let mask = uniform(&[2, 16, 16], 5, 0.0, 1.0);
    let inputs = stack_inputs(false, 2, 2, [3, 8, 8, 4], true);
    let robot = [inputs.clone(), inputs[1..].iter().map(|x| (x * 0.7).unwrap()).collect()].concat();
    let all =
        |(loss, mask_loss): (Tensor, Option<Tensor>)| [vec![loss], mask_loss.into_iter().collect()].concat();
    let count = inputs.len();
    let both = move |x: &[Tensor]| {
        let environment = [&x[..1], &x[count..]].concat();
        (x[..count].to_vec(), environment)
    };
    agree(
        &robot,
        |x| {
            let (a, b) = both(x);
            reconstruction_loss(
                &[(&a[0], &stack_layers(&a)), (&b[0], &stack_layers(&b))],
                &image,
                Some(&mask),
            )
            .map(all)
        },
        |x| {
            let (a, b) = both(x);
            let raws = [conv_up_stack(&a[0], &stack_layers(&a))?, conv_up_stack(&b[0], &stack_layers(&b))?];
            composite::picture_loss(&[&raws[0], &raws[1]], &image, Some(&mask)).map(all)
        },
    );
}

/// As the encoder and the decoders of a model of two cameras of 128 x 128 have them.
#[test]
fn six_channels_of_128_equal_their_composites_forward_and_backward() {
    let plain = |x: &[Tensor], op: fn(&Tensor, &Tensor) -> Result<Tensor>| {
        stack_layers(x).iter().try_fold(x[0].clone(), |y, layer| {
            let y = op(&y, layer.weight)?;
            match (layer.norm, layer.bias) {
                (Some((gain, shift, eps)), _) => composite::layer_norm_silu(&y, gain, shift, eps),
                (_, Some(bias)) => y.broadcast_add(bias),
                _ => Ok(y),
            }
        })
    };
    agree(
        &stack_inputs(true, 2, 128, [6, 4, 8, 16], false),
        |x| one(conv_down_stack(&x[0], &stack_layers(x))),
        |x| one(plain(x, composite::conv_down)),
    );
    let bytes: Vec<u8> = (0..2 * 128 * 128 * 6).map(|i| (i * 91 % 256) as u8).collect();
    let image = Tensor::from_vec(bytes, (2, 128, 256, 3), &Device::Cpu).unwrap();
    let mask = uniform(&[2, 128, 256], 5, 0.0, 1.0);
    let inputs = stack_inputs(false, 2, 16, [6, 8, 4, 8], true);
    let all =
        |(loss, mask_loss): (Tensor, Option<Tensor>)| [vec![loss], mask_loss.into_iter().collect()].concat();
    agree(
        &inputs,
        |x| reconstruction_loss(&[(&x[0], &stack_layers(x))], &image, Some(&mask)).map(all),
        |x| {
            let raw = plain(x, composite::conv_up)?.reshape((2, 128, 256, 4))?;
            composite::picture_loss(&[&raw], &image, Some(&mask)).map(all)
        },
    );
}

#[test]
fn images_without_gradient_cost_none_and_change_nothing() {
    let inputs = stack_inputs(true, 2, 8, [3, 4, 4, 4], false);
    let image = inputs[0].clone();
    let weights: Vec<Var> = inputs[1..].iter().map(|x| Var::from_tensor(x).unwrap()).collect();
    let all: Vec<Tensor> =
        std::iter::once(image.clone()).chain(weights.iter().map(|w| w.as_tensor().clone())).collect();
    let y = conv_down_stack(&all[0], &stack_layers(&all)).unwrap();
    let grads = y.sum_all().unwrap().backward().unwrap();
    assert!(grads.get(&image).is_none());
    assert!(weights.iter().all(|w| grads.get(w).is_some()));
    let plain = conv_down_stack(&inputs[0], &stack_layers(&inputs)).unwrap();
    assert!(!plain.track_op());
    assert_eq!(
        plain.flatten_all().unwrap().to_vec1::<f32>().unwrap(),
        y.flatten_all().unwrap().to_vec1::<f32>().unwrap()
    );
}

#[test]
fn wrong_shapes_are_errors_that_name_the_op() {
    let x = random(&[2, 4, 4, 3], 1);
    let message = |result: Result<Tensor>| result.unwrap_err().to_string();
    assert!(message(conv_down(&x, &random(&[2, 5, 4, 4], 2))).contains("conv-down"));
    assert!(message(conv_up(&x, &random(&[4, 2, 4, 4], 2))).contains("conv-up"));
    assert!(message(linear(&x, &random(&[2, 5], 2), None)).contains("linear"));
    assert!(message(layer_norm(&x, &random(&[4], 2), &random(&[3], 3), 1e-3)).contains("layer-norm"));
    assert!(message(recurrent_update(&random(&[2, 5], 1), &random(&[2, 2], 2))).contains("recurrent-update"));
}
